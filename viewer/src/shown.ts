// A scene on the page, and what was found in it for the last word.

import { boxAround } from "./boxes";
import { findClusters } from "./clusters";
import { paintLabels, paintObjects, paintPca, paintWeights, paintWord, type Legend, type Mode } from "./colors";
import type { Pane } from "./pane";
import type { Scene } from "./scene";
import type { Answer, Answers, FoundBox, Judged, Labels } from "./types";

export class Shown {
  answer: Answer | null = null;
  /** The boxes at the default threshold with their probabilities, once they are known. */
  judged: Judged | null = null;
  boxes: FoundBox[] = [];
  labels: Labels | null = null;
  /** Why the last word has no answer. */
  problem = "";

  constructor(
    readonly pane: Pane,
    readonly scene: Scene,
    readonly answers: Answers,
  ) {}

  /** The relevancy from which on Gaussians are taken; `threshold` is that of the slider, null = the default. */
  cutoff(threshold: number | null): number {
    return threshold ?? this.answer?.threshold ?? Infinity;
  }

  findBoxes(threshold: number | null): void {
    const { answer, judged, scene } = this;
    if (!answer || !scene.geometry) this.boxes = [];
    else if (threshold === null && judged) this.boxes = judged.boxes;
    else {
      const means = scene.geometry.means;
      const weight = (row: number): number => scene.weight(row);
      const clusters = findClusters(answer.relevancy, this.cutoff(threshold), means, weight, scene.meta.localize);
      this.boxes = clusters.map((each, rank) => boxAround(answer.word, rank, each, means, scene.up));
    }
  }

  /** Colors the Gaussians, and tells what the colors mean; null where the mode has none and the splat's own are shown. */
  paint(mode: Mode, threshold: number | null): Legend | null {
    const { pane, scene, answer, labels } = this;
    let legend: Legend | null = null;
    if (mode === "word" && answer) {
      pane.paint((rgba) => {
        legend = paintWord(rgba, scene, pane.base, answer.relevancy, this.cutoff(threshold), answer.word);
      });
    } else if (mode === "pca") pane.paint((rgba) => (legend = paintPca(rgba, scene)));
    else if (mode === "weight") pane.paint((rgba) => (legend = paintWeights(rgba, scene)));
    else if (mode === "label" && labels) pane.paint((rgba) => (legend = paintLabels(rgba, scene, labels)));
    else if (mode === "object" && scene.objects) pane.paint((rgba) => (legend = paintObjects(rgba, scene)));
    else pane.paint(null);
    return legend;
  }
}
