// The side panel. Every text is set as text, never as markup.

import type { Legend, Mode } from "./colors";
import type { Move } from "./controls";

export function make<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  className = "",
  text = "",
): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  if (className) element.className = className;
  if (text) element.textContent = text;
  return element;
}

export interface BoxRow {
  text: string;
  side: string;
  detail: string;
  chosen: boolean;
  choose: () => void;
}

export interface Chosen {
  title: string;
  detail: string;
  /** The known words with their cosines, for each scene. */
  words: { of: string; list: [string, number][] }[];
  views: { name: string; url: string | null; stand: () => void }[];
}

export interface PanelActions {
  ask: (word: string) => void;
  mode: (mode: Mode) => void;
  threshold: (value: number | null) => void;
  move: (move: Move) => void;
  stand: (view: number) => void;
  overview: () => void;
  cameras: (shown: boolean) => void;
  boxes: (shown: boolean) => void;
}

const MODES: [Mode, string, string][] = [
  ["photo", "Photo", "The colors of the splat"],
  ["pca", "Features", "Principal components of the features"],
  ["word", "Word", "Relevancy of the word that was asked"],
  ["label", "Labels", "The best known word of each Gaussian"],
  ["weight", "Visibility", "How much each Gaussian was seen"],
  ["object", "Objects", "Labeled objects of the scene"],
];

export class Panel {
  readonly element = make("aside", "panel");
  private readonly input = make("input");
  private readonly status = make("div", "status");
  private readonly slider = make("input");
  private readonly value = make("output");
  private readonly reset = make("button", "link", "default");
  private readonly thresholdRow = make("section", "threshold");
  private readonly modes = new Map<Mode, HTMLButtonElement>();
  private readonly legend = make("div", "legend");
  private readonly boxList = make("div", "list");
  private readonly chosen = make("section", "selected");
  private readonly viewSelect = make("select");
  private readonly moves = new Map<Move, HTMLButtonElement>();

  constructor(
    private readonly actions: PanelActions,
    about: { title: string; detail: string; words: string[]; views: string[]; notes: string[]; open: boolean; hasObjects: boolean },
  ) {
    const head = make("header");
    head.append(make("h1", "", about.title), make("p", "faint", about.detail));
    this.element.append(head, this.search(about.words, about.open), this.thresholdSection());
    this.element.append(this.colors(about.hasObjects), this.boxList, this.chosen, this.camera(about.views));
    this.chosen.hidden = true;
    if (about.notes.length) {
      const notes = make("section", "notes");
      for (const note of about.notes) notes.append(make("p", "faint", note));
      this.element.append(notes);
    }
    const help = make("details", "help");
    help.append(make("summary", "", "Keys and mouse"));
    for (const line of [
      "Drag turns, right-drag or Shift-drag shifts, the wheel goes nearer.",
      "W A S D or arrows move, Q and E lower and raise, Shift is faster.",
      "A click names what is there; a click on a camera stands there.",
    ]) {
      help.append(make("p", "faint", line));
    }
    this.element.append(help);
  }

  private search(words: string[], open: boolean): HTMLElement {
    const form = make("form", "search");
    const known = make("datalist");
    known.id = "known-words";
    for (const word of words) {
      const option = make("option");
      option.value = word;
      known.append(option);
    }
    this.input.type = "search";
    this.input.maxLength = 500;
    this.input.placeholder = open ? "a word or a phrase" : "a known word";
    this.input.setAttribute("list", known.id);
    this.input.setAttribute("aria-label", "Word to search for");
    this.input.autocomplete = "off";
    form.append(this.input, make("button", "primary", "Find"), known);
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      const word = this.input.value.trim();
      if (word) this.actions.ask(word);
    });
    this.status.setAttribute("role", "status");
    const section = make("section");
    section.append(form, this.status);
    return section;
  }

  private thresholdSection(): HTMLElement {
    Object.assign(this.slider, { type: "range", min: "0", max: "1", step: "0.005" });
    this.slider.setAttribute("aria-label", "Threshold of relevancy");
    this.slider.addEventListener("input", () => this.actions.threshold(Number(this.slider.value)));
    this.reset.type = "button";
    this.reset.addEventListener("click", () => this.actions.threshold(null));
    const head = make("div", "row");
    head.append(make("label", "", "Threshold"), this.value, this.reset);
    this.thresholdRow.append(head, this.slider);
    this.thresholdRow.hidden = true;
    return this.thresholdRow;
  }

  private colors(hasObjects: boolean): HTMLElement {
    const section = make("section");
    const group = make("div", "segments");
    group.setAttribute("role", "group");
    group.setAttribute("aria-label", "Color by");
    for (const [mode, name, title] of MODES) {
      if (mode === "object" && !hasObjects) continue;
      const button = make("button", "", name);
      button.type = "button";
      button.title = title;
      button.addEventListener("click", () => this.actions.mode(mode));
      this.modes.set(mode, button);
      group.append(button);
    }
    section.append(group, this.legend);
    return section;
  }

  private camera(views: string[]): HTMLElement {
    const section = make("section", "camera");
    const group = make("div", "segments");
    for (const [move, name] of [["orbit", "Orbit"], ["walk", "Walk"]] as [Move, string][]) {
      const button = make("button", "", name);
      button.type = "button";
      button.addEventListener("click", () => this.actions.move(move));
      this.moves.set(move, button);
      group.append(button);
    }
    const overview = make("button", "", "Overview");
    overview.type = "button";
    overview.addEventListener("click", () => this.actions.overview());
    group.append(overview);
    section.append(group);
    if (views.length) {
      const row = make("div", "row");
      const first = make("option", "", `Stand at a camera (${views.length})`);
      first.value = "";
      this.viewSelect.append(first);
      views.forEach((name, number) => {
        const option = make("option", "", name);
        option.value = String(number);
        this.viewSelect.append(option);
      });
      this.viewSelect.setAttribute("aria-label", "Camera of the scene");
      this.viewSelect.addEventListener("change", () => {
        if (this.viewSelect.value) this.actions.stand(Number(this.viewSelect.value));
      });
      row.append(this.viewSelect);
      section.append(row);
    }
    const checks = make("div", "row checks");
    checks.append(this.check("Boxes", true, this.actions.boxes));
    if (views.length) checks.append(this.check("Cameras", false, this.actions.cameras));
    section.append(checks);
    return section;
  }

  private check(name: string, on: boolean, changed: (on: boolean) => void): HTMLElement {
    const label = make("label", "check");
    const box = make("input");
    box.type = "checkbox";
    box.checked = on;
    box.addEventListener("change", () => changed(box.checked));
    label.append(box, name);
    return label;
  }

  showWord(word: string): void {
    this.input.value = word;
  }

  showStatus(lines: { text: string; bad?: boolean }[]): void {
    this.status.replaceChildren(...lines.map(({ text, bad }) => make("p", bad ? "bad" : "", text)));
  }

  showThreshold(value: number | null, isDefault: boolean): void {
    this.thresholdRow.hidden = value === null;
    if (value === null) return;
    this.slider.value = String(value);
    this.value.textContent = value.toFixed(2);
    this.reset.hidden = isDefault;
  }

  showMode(mode: Mode): void {
    for (const [name, button] of this.modes) button.setAttribute("aria-pressed", String(name === mode));
  }

  showMove(move: Move): void {
    for (const [name, button] of this.moves) button.setAttribute("aria-pressed", String(name === move));
  }

  showView(view: number | null): void {
    this.viewSelect.value = view === null ? "" : String(view);
  }

  showLegend(legend: Legend, ask: ((word: string) => void) | null): void {
    this.legend.replaceChildren();
    if (legend.title) this.legend.append(make("p", "faint", legend.title));
    if (legend.kind === "ramp") {
      const ramp = make("div", "ramp");
      ramp.style.backgroundImage = legend.ramp ?? "";
      const ends = make("div", "row ends");
      ends.append(make("span", "", legend.ends?.[0] ?? ""), make("span", "", legend.ends?.[1] ?? ""));
      this.legend.append(ramp, ends);
    }
    if (legend.kind === "list") {
      const list = make("div", "swatches");
      for (const { name, color } of legend.entries ?? []) {
        const entry = make("button", "swatch");
        entry.type = "button";
        const dot = make("span", "dot");
        dot.style.backgroundColor = color;
        entry.append(dot, make("bdi", "", name));
        if (ask) entry.addEventListener("click", () => ask(name));
        else entry.disabled = true;
        list.append(entry);
      }
      this.legend.append(list);
    }
  }

  showBoxes(rows: BoxRow[]): void {
    this.boxList.replaceChildren();
    for (const row of rows) {
      const button = make("button", row.chosen ? "box chosen" : "box");
      button.type = "button";
      button.append(make("bdi", "", row.text), make("span", "side", row.side), make("span", "faint", row.detail));
      button.addEventListener("click", row.choose);
      this.boxList.append(button);
    }
  }

  showChosen(chosen: Chosen | null): void {
    this.chosen.replaceChildren();
    this.chosen.hidden = chosen === null;
    if (!chosen) return;
    this.chosen.append(make("h2", "", chosen.title), make("p", "faint", chosen.detail));
    for (const { of, list } of chosen.words) {
      if (of) this.chosen.append(make("p", "faint", of));
      const words = make("div", "words");
      for (const [name, cosine] of list) {
        const button = make("button", "word");
        button.type = "button";
        button.append(make("bdi", "", name), make("span", "faint", cosine.toFixed(2)));
        button.addEventListener("click", () => this.actions.ask(name));
        words.append(button);
      }
      this.chosen.append(words);
    }
    const views = make("div", "views");
    for (const { name, url, stand } of chosen.views) {
      const button = make("button", "view");
      button.type = "button";
      button.title = "Stand there";
      if (url) {
        const image = make("img");
        image.src = url;
        image.alt = "";
        button.append(image);
      }
      button.append(make("bdi", "", name));
      button.addEventListener("click", stand);
      views.append(button);
    }
    this.chosen.append(views);
  }
}
