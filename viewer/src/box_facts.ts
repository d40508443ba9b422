// What is asked of a box: which Gaussians it holds, and how large it is in words.

import type { Scene } from "./scene";
import type { FoundBox } from "./types";

export function holds(box: FoundBox, point: ArrayLike<number>): boolean {
  const slack = 1e-4 * Math.hypot(...box.size);
  return [0, 1, 2].every((axis) => {
    let along = 0;
    for (let k = 0; k < 3; k++) along += (box.rotation[3 * k + axis] ?? 0) * ((point[k] ?? 0) - (box.center[k] ?? 0));
    return Math.abs(along) <= (box.size[axis] ?? 0) / 2 + slack;
  });
}

export function sizeOf(box: FoundBox, scene: Scene): string {
  const unit = scene.meta.metresPerUnit;
  const sides = box.size.map((side) => (unit ? side * unit : side).toFixed(2)).join(" × ");
  return `${sides}${unit ? " m" : ""}, ${box.count.toLocaleString("en")} Gaussians`;
}

/** Gaussians of a box: those that it was made of, or those at or above a threshold that lie in it; evenly thinned. */
export function rowsIn(box: FoundBox, means: Float32Array, relevancy: Float32Array | null, threshold: number, most: number): number[] {
  let rows = box.rows ? [...box.rows] : [];
  if (!box.rows && relevancy) {
    relevancy.forEach((value, row) => {
      if (value >= threshold && holds(box, means.subarray(3 * row, 3 * row + 3))) rows.push(row);
    });
  }
  const step = Math.max(1, Math.ceil(rows.length / most));
  rows = rows.filter((_, place) => place % step === 0);
  return rows;
}
