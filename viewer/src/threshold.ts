// The relevancy from which on Gaussians are taken: gsencoder/infer/relevancy.py in JavaScript.

import type { ThresholdSettings } from "./types";

const NORMAL_MAD = 1.4826;

/** Median of values, which are sorted in place; numpy's. */
export function medianOf(values: Float32Array): number {
  if (!values.length) return NaN;
  values.sort();
  const middle = values.length >> 1;
  const high = values[middle] ?? NaN;
  return values.length % 2 ? high : ((values[middle - 1] ?? NaN) + high) / 2;
}

/** Median and spread of the relevancy of a word over a scene; NaN entries are left out. */
export function background(relevancy: Float32Array): { median: number; spread: number } {
  const seen = relevancy.filter((value) => !Number.isNaN(value));
  const median = medianOf(seen);
  for (let row = 0; row < seen.length; row++) seen[row] = Math.abs((seen[row] ?? 0) - median);
  return { median, spread: NORMAL_MAD * medianOf(seen) };
}

export function bestOf(relevancy: Float32Array): number {
  let best = -Infinity;
  for (const value of relevancy) if (value > best) best = value;
  return best;
}

export function thresholdOf(relevancy: Float32Array, settings: ThresholdSettings): number | null {
  const best = bestOf(relevancy);
  if (best === -Infinity) return null;
  if (settings.kind === "fixed") return settings.fixed;
  if (settings.kind === "quantile") {
    const seen = relevancy.filter((value) => !Number.isNaN(value)).sort();
    const place = settings.quantile * (seen.length - 1);
    const low = Math.floor(place);
    const first = seen[low] ?? 0;
    return first + (place - low) * ((seen[Math.min(low + 1, seen.length - 1)] ?? 0) - first);
  }
  const share = settings.relative * best;
  if (settings.kind === "relative") return share;
  if (share >= settings.fixed) return settings.fixed;
  const { median, spread } = background(relevancy);
  return Math.min(settings.fixed, Math.max(share, median + settings.noise * spread));
}
