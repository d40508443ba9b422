// What the page knows of a scene; see gsencoder/infer/page/page.py.

export interface SceneMeta {
  name: string;
  title: string;
  space: string;
  count: number;
  total: number;
  notes: string[];
  origin: [number, number, number];
  up: [number, number, number] | null;
  metresPerUnit: number | null;
  spacing: number;
  shDegree: number;
  weights: [number, number];
  views: string[];
  photographs: boolean;
  words: string[];
  objects: string[];
}

/** A box as `gsencoder localize` writes it, in world coordinates. */
export interface SentBox {
  query: string;
  rank: number;
  score: number;
  probability: number;
  count: number;
  obb: { center: number[]; rotation: number[][]; size: [number, number, number] };
}

export interface SentBoxes {
  boxes: SentBox[];
  probability: number;
}

export interface FileMeta extends SceneMeta {
  rank: number;
  floor: number;
  featureError: number;
  /** Of each known word, in their order. */
  answers: (SentBoxes & { threshold: number | null })[];
  labels: string[];
  photographViews: number[];
  photographSizes: number[];
}

export interface PageSettings {
  kind: "server" | "file";
  scenes: number;
  notes: string[];
}

/** Relevancy of a word: NaN where a Gaussian has no feature. */
export interface Answer {
  word: string;
  relevancy: Float32Array;
  threshold: number | null;
}

/** A box in the coordinates of the scene, origin taken off. */
export interface FoundBox {
  word: string;
  rank: number;
  score: number;
  probability: number;
  center: [number, number, number];
  /** Columns are the axes; row-major. */
  rotation: number[];
  size: [number, number, number];
  count: number;
}

/** The boxes of a word, and the probability that it is in the scene. */
export interface Found {
  boxes: FoundBox[];
  probability: number;
}

export interface Labels {
  names: string[];
  numbers: Uint16Array;
}

/** Where answers come from: a server, or the file itself. */
export interface Answers {
  ask(word: string): Promise<Answer>;
  /** The boxes at a threshold, null = the default; a file knows those of the default alone. */
  boxes(word: string, threshold: number | null): Promise<Found>;
  bestWords(rows: number[]): Promise<[string, number][]>;
  labels(): Promise<Labels>;
  /** The address of a view's photograph, or null. */
  photograph(view: number): Promise<string | null>;
}
