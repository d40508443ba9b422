// A scene on the page, and what was found in it for the last word.

import { paintLabels, paintObjects, paintPca, paintWeights, paintWord, type Legend, type Mode } from "./colors";
import type { Pane } from "./pane";
import type { Scene } from "./scene";
import type { Answer, Answers, Found, FoundBox, Labels } from "./types";

export class Shown {
  answer: Answer | null = null;
  /** The boxes of the last word, once they are known. */
  found: Found | null = null;
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

  get boxes(): FoundBox[] {
    return this.found?.boxes ?? [];
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
