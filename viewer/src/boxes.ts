// The smallest box around points that stands upright: gsencoder/infer/boxes.py for a known up.

import type { Cluster } from "./clusters";
import type { FoundBox } from "./types";

type Vector = [number, number, number];

function cross(a: Vector, b: Vector): Vector {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

function unit(a: Vector): Vector {
  const length = Math.hypot(...a);
  return [a[0] / length, a[1] / length, a[2] / length];
}

function hull(points: [number, number][]): [number, number][] {
  const sorted = [...points].sort((a, b) => a[0] - b[0] || a[1] - b[1]);
  const half = (list: [number, number][]): [number, number][] => {
    const chain: [number, number][] = [];
    for (const point of list) {
      while (chain.length > 1) {
        const [a, b] = [chain[chain.length - 2], chain[chain.length - 1]] as [[number, number], [number, number]];
        if ((b[0] - a[0]) * (point[1] - a[1]) - (b[1] - a[1]) * (point[0] - a[0]) > 0) break;
        chain.pop();
      }
      chain.push(point);
    }
    return chain.slice(0, -1);
  };
  return [...half(sorted), ...half(sorted.reverse())];
}

/** Angle of the rectangle of least area around points of a plane. */
export function smallestRectangle(points: [number, number][]): number {
  const corners = hull(points);
  let best = 0;
  let least = Infinity;
  corners.forEach((corner, place) => {
    const next = corners[(place + 1) % corners.length] ?? corner;
    const quarter = Math.PI / 2;
    const turn = Math.atan2(next[1] - corner[1], next[0] - corner[0]);
    const angle = ((turn % quarter) + quarter) % quarter;
    const [c, s] = [Math.cos(angle), Math.sin(angle)];
    let [left, right, low, high] = [Infinity, -Infinity, Infinity, -Infinity];
    for (const [x, y] of corners) {
      left = Math.min(left, c * x + s * y);
      right = Math.max(right, c * x + s * y);
      low = Math.min(low, c * y - s * x);
      high = Math.max(high, c * y - s * x);
    }
    const area = (right - left) * (high - low);
    // Of equal rectangles the least turned one.
    if (area < least * (1 - 1e-9) || (area <= least * (1 + 1e-9) && angle < best)) {
      least = Math.min(area, least);
      best = angle;
    }
  });
  return best;
}

export function boxAround(word: string, rank: number, cluster: Cluster, means: Float32Array, up: Vector): FoundBox {
  const normal = unit(up);
  const axis = [0, 1, 2].reduce((a, b) => (Math.abs(normal[b] ?? 0) < Math.abs(normal[a] ?? 0) ? b : a), 0);
  const first = unit(cross([axis === 0 ? 1 : 0, axis === 1 ? 1 : 0, axis === 2 ? 1 : 0], normal));
  const second = cross(normal, first);
  const at = (row: number, direction: Vector): number =>
    (means[3 * row] ?? 0) * direction[0] + (means[3 * row + 1] ?? 0) * direction[1] + (means[3 * row + 2] ?? 0) * direction[2];
  const flat: [number, number][] = Array.from(cluster.rows, (row) => [at(row, first), at(row, second)]);
  const angle = smallestRectangle(flat);
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  const x: Vector = [c * first[0] + s * second[0], c * first[1] + s * second[1], c * first[2] + s * second[2]];
  const axes: Vector[] = [x, cross(normal, x), normal];
  const center: Vector = [0, 0, 0];
  const size = axes.map((direction) => {
    let [low, high] = [Infinity, -Infinity];
    for (const row of cluster.rows) {
      const value = at(row, direction);
      low = Math.min(low, value);
      high = Math.max(high, value);
    }
    for (let k = 0; k < 3; k++) center[k] = (center[k] ?? 0) + ((low + high) / 2) * (direction[k] ?? 0);
    return high - low;
  }) as Vector;
  const rotation = [0, 1, 2].flatMap((k) => axes.map((direction) => direction[k] ?? 0));
  return {
    word,
    rank,
    score: cluster.score,
    probability: null,
    center,
    rotation,
    size,
    rows: cluster.rows,
    count: cluster.rows.length,
  };
}
