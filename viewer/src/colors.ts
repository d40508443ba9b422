// Colors of Gaussians, as RGBA bytes, and the legends that say what they mean.

import type { Scene } from "./scene";
import type { Labels } from "./types";

export type Mode = "photo" | "pca" | "word" | "weight" | "label" | "object";

export interface Legend {
  kind: "none" | "ramp" | "list";
  title: string;
  /** Of a ramp: what its ends mean. */
  ends?: [string, string];
  ramp?: string;
  /** Of a list. */
  entries?: { name: string; color: string }[];
}

type Rgb = [number, number, number];

/** Turbo (Mikhailov 2019) by its polynomial. */
export function turbo(t: number): Rgb {
  const x = Math.max(0, Math.min(1, t));
  const channel = (a: number, b: number, c: number, d: number, e: number, f: number): number =>
    Math.round(255 * Math.max(0, Math.min(1, a + x * (b + x * (c + x * (d + x * (e + x * f)))))));
  return [
    channel(0.13572138, 4.6153926, -42.66032258, 132.13108234, -152.94239396, 59.28637943),
    channel(0.09140261, 2.19418839, 4.84296658, -14.18503333, 4.27729857, 2.82956604),
    channel(0.1066733, 12.64194608, -60.58204836, 110.36276771, -89.90310912, 27.34824973),
  ];
}

const VIRIDIS: Rgb[] = [
  [68, 1, 84], [72, 40, 120], [62, 74, 137], [49, 104, 142], [38, 130, 142],
  [31, 158, 137], [53, 183, 121], [110, 206, 88], [181, 222, 43], [253, 231, 37],
];

export function viridis(t: number): Rgb {
  const place = Math.max(0, Math.min(1, t)) * (VIRIDIS.length - 1);
  const low = Math.min(Math.floor(place), VIRIDIS.length - 2);
  const [a, b] = [VIRIDIS[low] as Rgb, VIRIDIS[low + 1] as Rgb];
  return a.map((value, k) => Math.round(value + (place - low) * ((b[k] ?? 0) - value))) as Rgb;
}

/** Distinct colors: hues in golden steps, in three lightnesses. */
export function distinct(index: number): Rgb {
  const hue = (index * 137.508 + 205) % 360;
  const light = [0.62, 0.74, 0.5][index % 3] as number;
  const saturation = 0.62;
  const f = (n: number): number => {
    const k = (n + hue / 30) % 12;
    return Math.round(255 * (light - saturation * Math.min(light, 1 - light) * Math.max(-1, Math.min(k - 3, 9 - k, 1))));
  };
  return [f(0), f(8), f(4)];
}

export function css(color: Rgb): string {
  return `rgb(${color.join(" ")})`;
}

function gradient(map: (t: number) => Rgb): string {
  return `linear-gradient(to right, ${Array.from({ length: 13 }, (_, k) => css(map(k / 12))).join(", ")})`;
}

const NONE: Rgb = [90, 90, 90];

/** The splat's own opacities stay; only colors are written. `rgba` holds the opacities already. */
function fill(rgba: Uint8Array, count: number, color: (row: number) => Rgb): void {
  for (let row = 0; row < count; row++) {
    const [r, g, b] = color(row);
    rgba[4 * row] = r;
    rgba[4 * row + 1] = g;
    rgba[4 * row + 2] = b;
  }
}

export function paintPca(rgba: Uint8Array, scene: Scene): Legend {
  const { pca, count } = scene;
  for (let row = 0; row < count; row++) rgba.set(pca.subarray(3 * row, 3 * row + 3), 4 * row);
  return { kind: "none", title: "Similar colors are similar features: their first three principal components." };
}

export function paintWeights(rgba: Uint8Array, scene: Scene): Legend {
  const codes = scene.weightCodes;
  const table = Array.from({ length: 256 }, (_, code) => (code ? viridis((code - 1) / 254) : NONE));
  fill(rgba, scene.count, (row) => table[codes[row] ?? 0] as Rgb);
  const [low, high] = scene.meta.weights;
  return {
    kind: "ramp",
    title: "Visibility: summed blending weight in the views, pixels (logarithmic)",
    ends: [low.toPrecision(2), high.toPrecision(3)],
    ramp: gradient(viridis),
  };
}

const LEVELS = 512;

/** Relevancy over a dimmed photograph: what is below the threshold is nearly grey. */
export function paintWord(
  rgba: Uint8Array,
  scene: Scene,
  base: Uint8Array,
  relevancy: Float32Array,
  threshold: number,
  word: string,
): Legend {
  const table = new Uint8Array(Array.from({ length: LEVELS }, (_, level) => turbo(level / (LEVELS - 1))).flat());
  for (let row = 0; row < scene.count; row++) {
    const value = relevancy[row] as number;
    const at = 4 * row;
    const grey = 0.299 * (base[at] as number) + 0.587 * (base[at + 1] as number) + 0.114 * (base[at + 2] as number);
    // NaN compares false: what was never seen stays grey.
    const picked = value >= threshold;
    const share = value > 0 ? value : 0;
    const mix = picked ? 0.85 : 0.4 * (share / Math.max(threshold, 1e-6)) ** 2;
    const dim = (1 - mix) * (picked ? grey : 0.6 * grey);
    const color = 3 * Math.min(LEVELS - 1, Math.round(share * (LEVELS - 1)));
    rgba[at] = mix * (table[color] as number) + dim;
    rgba[at + 1] = mix * (table[color + 1] as number) + dim;
    rgba[at + 2] = mix * (table[color + 2] as number) + dim;
  }
  return {
    kind: "ramp",
    title: `Relevancy of “${word}”; below the threshold it is dimmed`,
    ends: ["0", "1"],
    ramp: gradient(turbo),
  };
}

export function paintLabels(rgba: Uint8Array, scene: Scene, labels: Labels): Legend {
  fill(rgba, scene.count, (row) => {
    const label = labels.numbers[row] ?? 65535;
    return label === 65535 ? NONE : distinct(label);
  });
  const entries = labels.names.slice(0, 14).map((name, index) => ({ name, color: css(distinct(index)) }));
  return { kind: "list", title: "Best word of each Gaussian", entries };
}

export function paintObjects(rgba: Uint8Array, scene: Scene): Legend {
  const { objects } = scene;
  fill(rgba, scene.count, (row) => {
    const number = objects?.[row] ?? 0;
    return number ? distinct(number - 1) : NONE;
  });
  const entries = scene.meta.objects.slice(0, 14).map((name, index) => ({
    name: name || `object ${index + 1}`,
    color: css(distinct(index)),
  }));
  return { kind: "list", title: "Labeled objects, by their boxes", entries };
}
