// Boxes as they are sent, and what is asked of them: which Gaussians it holds, and how large it is in words.

import type { Scene } from "./scene";
import type { Found, FoundBox, SentBoxes } from "./types";

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

/** Boxes as they were sent, in the coordinates of a scene with this origin. */
export function foundOf(sent: SentBoxes, origin: number[]): Found {
  const boxes = sent.boxes.map(({ query, obb, ...box }): FoundBox => ({
    ...box,
    word: query,
    center: obb.center.map((value, axis) => value - (origin[axis] ?? 0)) as [number, number, number],
    rotation: obb.rotation.flat(),
    size: obb.size,
  }));
  return { boxes, probability: sent.probability };
}

/** The Gaussians at or above a threshold that lie in a box, evenly thinned. */
export function rowsIn(box: FoundBox, means: Float32Array, relevancy: Float32Array, threshold: number, most: number): number[] {
  const rows: number[] = [];
  relevancy.forEach((value, row) => {
    if (value >= threshold && holds(box, means.subarray(3 * row, 3 * row + 3))) rows.push(row);
  });
  const step = Math.max(1, Math.ceil(rows.length / most));
  return rows.filter((_, place) => place % step === 0);
}
