// What happens on the page: words, thresholds, colors, clicks, and the camera that all panes share.

import * as THREE from "three";
import { holds, rowsIn, sizeOf } from "./box_facts";
import type { Legend, Mode } from "./colors";
import { Controls, type Move } from "./controls";
import { Frames } from "./frames";
import { Pane } from "./pane";
import { Panel, make, type Chosen } from "./panel";
import { bestViews } from "./picking";
import type { Scene } from "./scene";
import { Shown } from "./shown";
import type { Answers, FoundBox, PageSettings } from "./types";

const BEST_VIEWS = 4;
const SAMPLED_ROWS = 1000;
/** Milliseconds without a move of the slider after which boxes are asked for. */
const SLIDER_REST = 150;

export class App {
  mode: Mode = "photo";
  /** Milliseconds of the last word until it was answered, and until the frame that shows it was drawn. */
  readonly timings = { ask: 0, paint: 0 };
  readonly shown: Shown[];
  private readonly panel: Panel;
  private readonly controls: Controls;
  private threshold: number | null = null;
  private boxesShown = true;
  private chosenBox: FoundBox | null = null;
  private asked = 0;
  private searched = 0;
  private waiting: ReturnType<typeof setTimeout> | undefined;
  private readonly frames: Frames;
  private fast = false;

  constructor(
    private readonly root: HTMLElement,
    settings: PageSettings,
    scenes: { scene: Scene; answers: Answers }[],
  ) {
    const first = scenes[0]?.scene;
    if (!first) throw new Error("There is no scene on this page.");
    this.controls = new Controls(new THREE.Vector3(...first.up).normalize(), 1, () => {
      this.panel.showView(null);
      this.frames.moved();
    });
    this.frames = new Frames(
      (seconds) => this.controls.step(seconds, this.fast),
      async (moving) => {
        const fine = await Promise.all(this.shown.map(({ pane }) => pane.render(this.controls, moving)));
        return fine.every(Boolean);
      },
    );
    this.shown = scenes.map(({ scene, answers }) => {
      const pane = new Pane(scene, () => this.dirty(), (box) => void this.chooseBox(box));
      const [a, b] = [scene.meta.origin, first.meta.origin];
      pane.offset.set(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
      return new Shown(pane, scene, answers);
    });
    const words = [...new Set(this.shown.flatMap(({ scene }) => scene.meta.words))];
    const several = this.shown.length > 1;
    this.panel = new Panel(
      {
        ask: (word) => void this.ask(word),
        mode: (mode) => void this.color(mode),
        threshold: (value) => this.setThreshold(value),
        move: (move) => this.setMove(move),
        stand: (view) => this.stand(view),
        overview: () => this.overview(),
        cameras: (on) => this.shown.forEach(({ pane }) => pane.showCameras(on)),
        boxes: (on) => {
          this.boxesShown = on;
          this.showBoxes();
        },
      },
      {
        title: first.meta.name,
        detail: several
          ? this.shown.map(({ scene }) => `${scene.meta.title}: ${scene.meta.space}`).join("\n")
          : `${first.count.toLocaleString("en")} Gaussians · ${first.meta.space}`,
        words,
        views: first.views.map((view) => view.name),
        notes: [
          ...settings.notes,
          ...this.shown.flatMap(({ scene }) => scene.meta.notes.map((note) => (several ? `${scene.meta.title}: ${note}` : note))),
        ],
        open: settings.kind === "server",
        hasObjects: this.shown.some(({ scene }) => scene.objects !== null),
      },
    );
  }

  async start(): Promise<void> {
    const stage = make("main", "stage");
    for (const { pane } of this.shown) stage.append(pane.element);
    const loading = make("p", "message", "Reading the splat …");
    this.root.replaceChildren(stage, this.panel.element, loading);
    for (const { pane } of this.shown) {
      await pane.load();
      pane.showCameras(false);
      this.controls.listen(pane.canvas, (x, y) => void this.clicked(pane, x, y));
    }
    loading.remove();
    window.addEventListener("resize", () => this.dirty());
    window.addEventListener("keydown", (event) => (this.fast = event.shiftKey));
    window.addEventListener("keyup", (event) => (this.fast = event.shiftKey));
    this.setMove("orbit");
    this.panel.showMode(this.mode);
    if (this.shown[0]?.scene.views.length) this.stand(0);
    else this.overview();
    await this.frame();
  }

  // The camera.

  setMove(move: Move): void {
    this.controls.move = move;
    this.panel.showMove(move);
  }

  stand(number: number): void {
    const first = this.shown[0];
    const view = first?.scene.views[number];
    if (!first || !view) return;
    const forward = view.rotation.slice(6, 9);
    this.controls.stand(view, 0.3 * first.pane.size);
    const hit = first.pane.hit(view.center, forward);
    if (hit) this.controls.distance = hit.depth;
    this.panel.showView(number);
    this.dirty();
  }

  overview(): void {
    const first = this.shown[0];
    const geometry = first?.scene.geometry;
    if (!first || !geometry) return;
    const center = new THREE.Vector3();
    const step = Math.max(1, Math.floor(geometry.count / 5000));
    let number = 0;
    for (let row = 0; row < geometry.count; row += step, number++) {
      center.add(new THREE.Vector3().fromArray(geometry.means, 3 * row));
    }
    center.divideScalar(number);
    const up = new THREE.Vector3(...first.scene.up).normalize();
    const side = new THREE.Vector3(0.7, -0.6, 0.3);
    side.addScaledVector(up, -side.dot(up)).normalize();
    const from = center.clone().addScaledVector(side, 0.85 * first.pane.size).addScaledVector(up, 0.7 * first.pane.size);
    this.controls.lookFrom(from, center);
  }

  /** Where a point of a scene is seen on the page; null behind the camera. */
  placeOf(number: number, point: [number, number, number]): { x: number; y: number } | null {
    const pane = this.shown[number]?.pane;
    const place = pane?.place(new THREE.Vector3(...point));
    const corner = pane?.element.getBoundingClientRect();
    return place && corner ? { x: place.x + corner.left, y: place.y + corner.top } : null;
  }

  // Words.

  async ask(word: string): Promise<void> {
    const turn = ++this.asked;
    const begin = performance.now();
    this.threshold = null;
    this.chosenBox = null;
    this.panel.showWord(word);
    this.panel.showChosen(null);
    this.panel.showStatus([{ text: "Searching …" }]);
    const answers = await Promise.all(
      this.shown.map(({ answers: source }) =>
        source.ask(word).catch((error: unknown) => (error instanceof Error ? error.message : String(error))),
      ),
    );
    if (turn !== this.asked) return;
    this.timings.ask = performance.now() - begin;
    answers.forEach((answer, number) => {
      const shown = this.shown[number] as Shown;
      shown.problem = typeof answer === "string" ? answer : "";
      shown.answer = typeof answer === "string" ? null : answer;
      shown.found = null;
    });
    await this.color("word");
    await this.frame();
    this.timings.paint = performance.now() - begin;
    document.body.dataset.painted = word;
    await this.findBoxes();
    if (turn === this.asked) document.body.dataset.judged = word;
  }

  setThreshold(value: number | null): void {
    this.threshold = value;
    this.chosenBox = null;
    this.repaint();
    this.showStatus();
    clearTimeout(this.waiting);
    this.waiting = setTimeout(() => void this.findBoxes(), SLIDER_REST);
  }

  /** Asks for the boxes at the threshold; what the last call found stays. */
  private async findBoxes(): Promise<void> {
    const turn = ++this.searched;
    const failed = (error: unknown): string => (error instanceof Error ? error.message : String(error));
    await Promise.all(
      this.shown.map(async (shown) => {
        if (!shown.answer) return;
        const found = await shown.answers.boxes(shown.answer.word, this.threshold).catch(failed);
        if (turn !== this.searched) return;
        shown.problem = typeof found === "string" ? found : "";
        shown.found = typeof found === "string" ? null : found;
      }),
    );
    if (turn !== this.searched) return;
    this.showBoxes();
    this.showStatus();
  }

  private showStatus(): void {
    const several = this.shown.length > 1;
    const lines = this.shown.flatMap((shown) => {
      const before = several ? `${shown.scene.meta.title}: ` : "";
      if (shown.problem) return [{ text: before + shown.problem, bad: true }];
      const { answer, found, boxes } = shown;
      if (!answer) return [];
      const cutoff = shown.cutoff(this.threshold);
      let picked = 0;
      for (const value of answer.relevancy) if (value >= cutoff) picked++;
      if (found && this.threshold === null && !boxes.length) {
        return [{ text: `${before}absent (probability ${found.probability.toFixed(2)})` }];
      }
      const number = boxes.length === 1 ? "1 box" : `${boxes.length} boxes`;
      return [{ text: `${before}${number}, ${picked.toLocaleString("en")} Gaussians` }];
    });
    this.panel.showStatus(lines);
    const first = this.shown.find(({ answer }) => answer?.threshold != null);
    this.panel.showThreshold(first ? first.cutoff(this.threshold) : null, this.threshold === null);
  }

  private showBoxes(): void {
    const several = this.shown.length > 1;
    const rows = this.shown.flatMap((shown) =>
      shown.boxes.map((box) => ({
        text: several ? `${shown.scene.meta.title}: ${box.word}` : box.word,
        side: box.probability.toFixed(2),
        detail: sizeOf(box, shown.scene),
        chosen: box === this.chosenBox,
        choose: () => void this.chooseBox(box),
      })),
    );
    this.panel.showBoxes(rows);
    for (const shown of this.shown) {
      const { pane, boxes } = shown;
      const visible = this.boxesShown ? boxes : [];
      pane.showBoxes(
        visible.map((box) => ({
          box,
          label: `${box.word} ${box.probability.toFixed(2)}`,
          chosen: box === this.chosenBox,
        })),
      );
    }
  }

  // Colors.

  async color(mode: Mode): Promise<void> {
    this.mode = mode;
    this.panel.showMode(mode);
    if (mode === "label") {
      for (const shown of this.shown) shown.labels ??= await shown.answers.labels();
      if (this.mode !== mode) return;
    }
    this.repaint();
  }

  private repaint(): void {
    const legends = this.shown.flatMap((shown) => shown.paint(this.mode, this.threshold) ?? []);
    const waits = this.mode === "word" && this.shown.every(({ problem }) => !problem);
    const none: Legend = { kind: "none", title: waits ? "Type a word to color by its relevancy." : "" };
    const legend = legends.at(-1) ?? none;
    const asks = this.mode === "label" || this.mode === "object";
    this.panel.showLegend(legend, asks ? (word) => void this.ask(word) : null);
  }

  // Clicks.

  private async clicked(pane: Pane, x: number, y: number): Promise<void> {
    const view = pane.viewAt(x, y);
    if (view !== null) {
      this.stand(view);
      return;
    }
    const hit = pane.pickAt(x, y);
    const shown = this.shown.find((each) => each.pane === pane);
    if (!hit || !shown?.scene.geometry) return;
    this.controls.distance = hit.depth;
    const { means, scales } = shown.scene.geometry;
    const center = means.subarray(3 * hit.row, 3 * hit.row + 3);
    const radius = Math.max(...scales.subarray(3 * hit.row, 3 * hit.row + 3), shown.scene.meta.spacing);
    const within = shown.boxes.find((box) => holds(box, center));
    if (within && (shown.answer?.relevancy[hit.row] ?? 0) >= shown.cutoff(this.threshold)) {
      await this.chooseBox(within);
      return;
    }
    this.chosenBox = null;
    this.showBoxes();
    await this.describe(shown, [hit.row], center, radius, "", this.position(shown, center));
  }

  private position(shown: Shown, center: ArrayLike<number>): string {
    const { origin } = shown.scene.meta;
    return `at ${[0, 1, 2].map((axis) => ((center[axis] ?? 0) + (origin[axis] ?? 0)).toFixed(2)).join(", ")}`;
  }

  async chooseBox(box: FoundBox): Promise<void> {
    const shown = this.shown.find(({ boxes }) => boxes.includes(box));
    const geometry = shown?.scene.geometry;
    if (!shown || !geometry) return;
    this.chosenBox = box;
    this.showBoxes();
    const rows = rowsIn(box, geometry.means, shown.answer?.relevancy ?? new Float32Array(), shown.cutoff(this.threshold), SAMPLED_ROWS);
    const radius = Math.hypot(...box.size) / 2;
    const probable = `\nprobability ${box.probability.toFixed(2)}, score ${box.score.toFixed(2)}`;
    const detail = `${this.position(shown, box.center)}\n${sizeOf(box, shown.scene)}${probable}`;
    await this.describe(shown, rows, box.center, radius, box.word, detail);
  }

  private async describe(
    shown: Shown,
    rows: number[],
    center: ArrayLike<number>,
    radius: number,
    title: string,
    detail: string,
  ): Promise<void> {
    const { scene, answers } = shown;
    if (!scene.geometry) return;
    const several = this.shown.length > 1;
    // Two scenes of one splat have the same Gaussians.
    const others = this.shown.filter((each) => each === shown || each.scene.count === scene.count);
    const words = await Promise.all(
      others.map(async (each) => ({
        of: several ? each.scene.meta.title : "",
        list: rows.length ? await each.answers.bestWords(rows) : [],
      })),
    );
    const list = words[others.indexOf(shown)]?.list ?? [];
    const views = bestViews(scene.views, scene.geometry, center, radius, BEST_VIEWS);
    const chosen: Chosen = {
      title: title || (list[0]?.[0] ?? "no features"),
      detail,
      words,
      views: await Promise.all(
        views.map(async ({ view }) => ({
          name: scene.views[view]?.name ?? "",
          url: await answers.photograph(view).catch(() => null),
          stand: () => this.stand(view),
        })),
      ),
    };
    this.panel.showChosen(chosen);
    document.body.dataset.chosen = chosen.title;
  }

  // Frames.

  dirty(): void {
    this.frames.dirty();
  }

  /** Draws a frame, and resolves when it is drawn. */
  frame(): Promise<void> {
    return this.frames.frame();
  }
}
