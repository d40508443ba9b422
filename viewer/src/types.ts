// What the page knows of a scene; see gsencoder/infer/page/page.py.

export interface ThresholdSettings {
  kind: "adaptive" | "fixed" | "relative" | "quantile" | "otsu";
  fixed: number;
  relative: number;
  noise: number;
  quantile: number;
}

export interface LocalizeSettings {
  /** The radius of clusters, or the smallest one where it follows gaps. */
  eps: number;
  followsGaps: boolean;
  minSamples: number;
  minShare: number;
  minWeight: number;
  maxBoxes: number;
  minProbability: number;
  threshold: ThresholdSettings;
}

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
  localize: LocalizeSettings;
  objects: string[];
}

export type Coefficients = Record<string, number>;

export interface FileMeta extends SceneMeta {
  rank: number;
  floor: number;
  featureError: number;
  synonyms: Record<string, number[]>;
  trained: boolean[] | null;
  presence: { unknown: Coefficients; trained: Coefficients; untrained: Coefficients; smallestSpread: number };
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
  /** Null until it is known. */
  probability: number | null;
  center: [number, number, number];
  /** Columns are the axes; row-major. */
  rotation: number[];
  size: [number, number, number];
  /** Gaussians in it, where the page found it itself. */
  rows: Int32Array | null;
  count: number;
}

export interface Judged {
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
  /** The boxes at the default threshold with probabilities, given what the page found. */
  judge(answer: Answer, found: FoundBox[]): Promise<Judged>;
  bestWords(rows: number[]): Promise<[string, number][]>;
  labels(): Promise<Labels>;
  /** The address of a view's photograph, or null. */
  photograph(view: number): Promise<string | null>;
}
