// Selected Gaussians to clusters: DBSCAN on a grid, scores as in gsencoder/infer/boxes.py.

import type { LocalizeSettings } from "./types";

/** So many pairs of neighbors are looked at; above, points are clustered by occupied cells of eps / 4. */
const MAX_PAIRS = 3e7;

/** How clusters are joined: gsencoder/infer/localize.py says why. */
const EPS_SPACINGS = 1.5;
const SPARSE = 0.25;
const GROWTH = Math.SQRT2;
const SPARSE_RADII = 6;
const GAP = 0.25;
const STRAY = 0.02;
const WIDEST = 8;
const MAX_PARTS = 32;

export interface Cluster {
  rows: Int32Array;
  score: number;
  share: number;
}

interface Grid {
  /** Points by cell: `order[starts[c] … starts[c + 1]]` are those of cell c. */
  order: Int32Array;
  starts: Int32Array;
  cellOf: Map<number, number>;
  keys: Float64Array;
  low: [number, number, number];
  sides: [number, number, number];
  edge: number;
}

function makeGrid(points: Float32Array, edge: number): Grid {
  const count = points.length / 3;
  const low: [number, number, number] = [Infinity, Infinity, Infinity];
  const high: [number, number, number] = [-Infinity, -Infinity, -Infinity];
  for (let place = 0; place < points.length; place++) {
    const axis = (place % 3) as 0 | 1 | 2;
    const value = points[place] ?? 0;
    if (value < low[axis]) low[axis] = value;
    if (value > high[axis]) high[axis] = value;
  }
  const sides = [0, 1, 2].map((axis) => Math.floor(((high[axis] ?? 0) - (low[axis] ?? 0)) / edge) + 1) as [
    number,
    number,
    number,
  ];
  const cellOf = new Map<number, number>();
  const numbers = new Int32Array(count);
  const keyList: number[] = [];
  const counts: number[] = [];
  for (let point = 0; point < count; point++) {
    const x = Math.floor(((points[3 * point] ?? 0) - low[0]) / edge);
    const y = Math.floor(((points[3 * point + 1] ?? 0) - low[1]) / edge);
    const z = Math.floor(((points[3 * point + 2] ?? 0) - low[2]) / edge);
    const key = (x * sides[1] + y) * sides[2] + z;
    let cell = cellOf.get(key);
    if (cell === undefined) {
      cell = counts.length;
      cellOf.set(key, cell);
      keyList.push(key);
      counts.push(0);
    }
    numbers[point] = cell;
    counts[cell] = (counts[cell] ?? 0) + 1;
  }
  const starts = new Int32Array(counts.length + 1);
  for (let cell = 0; cell < counts.length; cell++) starts[cell + 1] = (starts[cell] ?? 0) + (counts[cell] ?? 0);
  const next = starts.slice(0, -1);
  const order = new Int32Array(count);
  for (let point = 0; point < count; point++) {
    const cell = numbers[point] ?? 0;
    order[next[cell] ?? 0] = point;
    next[cell] = (next[cell] ?? 0) + 1;
  }
  return { order, starts, cellOf, keys: Float64Array.from(keyList), low, sides, edge };
}

/** DBSCAN: −1 = noise. Neighbors within eps count, the point itself included, each with its weight. */
export function dbscan(points: Float32Array, eps: number, minSamples: number, weights?: Float32Array): Int32Array {
  const count = points.length / 3;
  const labels = new Int32Array(count).fill(-1);
  if (!count) return labels;
  const grid = makeGrid(points, eps);
  const limit = eps * eps;
  const found: number[] = [];
  const neighbors = (point: number): number => {
    found.length = 0;
    let total = 0;
    const px = points[3 * point] ?? 0;
    const py = points[3 * point + 1] ?? 0;
    const pz = points[3 * point + 2] ?? 0;
    const x = Math.floor((px - grid.low[0]) / eps);
    const y = Math.floor((py - grid.low[1]) / eps);
    const z = Math.floor((pz - grid.low[2]) / eps);
    for (let i = Math.max(0, x - 1); i <= Math.min(grid.sides[0] - 1, x + 1); i++) {
      for (let j = Math.max(0, y - 1); j <= Math.min(grid.sides[1] - 1, y + 1); j++) {
        for (let k = Math.max(0, z - 1); k <= Math.min(grid.sides[2] - 1, z + 1); k++) {
          const cell = grid.cellOf.get((i * grid.sides[1] + j) * grid.sides[2] + k);
          if (cell === undefined) continue;
          for (let place = grid.starts[cell] ?? 0; place < (grid.starts[cell + 1] ?? 0); place++) {
            const other = grid.order[place] ?? 0;
            const dx = (points[3 * other] ?? 0) - px;
            const dy = (points[3 * other + 1] ?? 0) - py;
            const dz = (points[3 * other + 2] ?? 0) - pz;
            if (dx * dx + dy * dy + dz * dz <= limit) {
              found.push(other);
              total += weights ? (weights[other] ?? 0) : 1;
            }
          }
        }
      }
    }
    return total;
  };
  const visited = new Uint8Array(count);
  const stack: number[] = [];
  let label = -1;
  for (let start = 0; start < count; start++) {
    if (visited[start]) continue;
    visited[start] = 1;
    if (neighbors(start) < minSamples) continue;
    label += 1;
    labels[start] = label;
    stack.push(...found);
    while (stack.length) {
      const point = stack.pop() ?? 0;
      if (labels[point] === -1) labels[point] = label;
      if (visited[point]) continue;
      visited[point] = 1;
      if (neighbors(point) >= minSamples) for (const other of found) if (!visited[other] || labels[other] === -1) stack.push(other);
    }
  }
  return labels;
}

function tooMany(points: Float32Array, eps: number): boolean {
  const { starts } = makeGrid(points, eps);
  let pairs = 0;
  for (let cell = 0; cell + 1 < starts.length; cell++) pairs += 27 * ((starts[cell + 1] ?? 0) - (starts[cell] ?? 0)) ** 2;
  return pairs > MAX_PAIRS;
}

function labelsOf(points: Float32Array, eps: number, minSamples: number): Int32Array {
  // Points at this distance are neighbors, also where their coordinates round: two units in the last place of float32.
  const largest = points.reduce((most, value) => Math.max(most, Math.abs(value)), 0);
  eps += 2 ** (Math.floor(Math.log2(largest || 1)) - 22);
  if (!tooMany(points, eps)) return dbscan(points, eps, minSamples);
  const grid = makeGrid(points, eps / 4);
  const cells = grid.keys.length;
  const centers = new Float32Array(3 * cells);
  const sizes = new Float32Array(cells);
  for (let cell = 0; cell < cells; cell++) {
    const from = grid.starts[cell] ?? 0;
    const to = grid.starts[cell + 1] ?? 0;
    sizes[cell] = to - from;
    for (let place = from; place < to; place++) {
      const point = grid.order[place] ?? 0;
      for (let axis = 0; axis < 3; axis++) {
        centers[3 * cell + axis] = (centers[3 * cell + axis] ?? 0) + (points[3 * point + axis] ?? 0) / (to - from);
      }
    }
  }
  const ofCells = dbscan(centers, eps, minSamples, sizes);
  const labels = new Int32Array(points.length / 3);
  for (let cell = 0; cell < cells; cell++) {
    for (let place = grid.starts[cell] ?? 0; place < (grid.starts[cell + 1] ?? 0); place++) {
      labels[grid.order[place] ?? 0] = ofCells[cell] ?? -1;
    }
  }
  return labels;
}

interface Part {
  rows: number[];
  points: Float32Array;
  /** Twice the root mean square distance from the center. */
  size: number;
}

function makePart(points: Float32Array, rows: number[]): Part {
  const own = new Float32Array(3 * rows.length);
  rows.forEach((row, place) => own.set(points.subarray(3 * row, 3 * row + 3), 3 * place));
  let variance = 0;
  for (let axis = 0; axis < 3; axis++) {
    let mean = 0;
    for (let place = axis; place < own.length; place += 3) mean += (own[place] ?? 0) / rows.length;
    for (let place = axis; place < own.length; place += 3) variance += ((own[place] ?? 0) - mean) ** 2 / rows.length;
  }
  return { rows, points: own, size: 2 * Math.sqrt(variance) };
}

/** Whether a point of the one lies within `limit` of one of the other. */
function areNear(larger: Float32Array, smaller: Float32Array, limit: number): boolean {
  const { low, sides, cellOf, starts, order } = makeGrid(larger, limit);
  for (let point = 0; point < smaller.length; point += 3) {
    const at = [0, 1, 2].map((axis) => Math.floor(((smaller[point + axis] ?? 0) - (low[axis] ?? 0)) / limit));
    const [x = 0, y = 0, z = 0] = at;
    for (let i = Math.max(0, x - 1); i <= Math.min(sides[0] - 1, x + 1); i++) {
      for (let j = Math.max(0, y - 1); j <= Math.min(sides[1] - 1, y + 1); j++) {
        for (let k = Math.max(0, z - 1); k <= Math.min(sides[2] - 1, z + 1); k++) {
          const cell = cellOf.get((i * sides[1] + j) * sides[2] + k);
          if (cell === undefined) continue;
          for (let place = starts[cell] ?? 0; place < (starts[cell + 1] ?? 0); place++) {
            const other = 3 * (order[place] ?? 0);
            let squared = 0;
            for (let axis = 0; axis < 3; axis++) {
              squared += ((larger[other + axis] ?? 0) - (smaller[point + axis] ?? 0)) ** 2;
            }
            if (squared <= limit * limit) return true;
          }
        }
      }
    }
  }
  return false;
}

/** DBSCAN labels after joining clusters whose gap is small beside their size (`cluster_by_gaps`). */
function labelsByGaps(points: Float32Array, smallest: number, minSamples: number): Int32Array {
  let radius = smallest;
  for (let step = 0; step < SPARSE_RADII; step++) {
    const noise = labelsOf(points, radius / EPS_SPACINGS, 5).reduce((sum, label) => sum + (label < 0 ? 1 : 0), 0);
    if (noise <= (SPARSE * points.length) / 3) break;
    radius *= GROWTH;
  }
  const labels = labelsOf(points, radius, minSamples);
  const groups: number[][] = [];
  labels.forEach((label, row) => {
    if (label >= 0) (groups[label] ??= []).push(row);
  });
  const bySize = (a: { length: number }, b: { length: number }): number => b.length - a.length;
  let parts = groups.sort(bySize).slice(0, MAX_PARTS).map((rows) => makePart(points, rows));
  const apart = new Map<Part, Set<Part>>();
  const belongTogether = (larger: Part, smaller: Part): boolean => {
    if (smaller.rows.length < STRAY * larger.rows.length) return false;
    const limit = Math.min(GAP * Math.max(larger.size, smaller.size), WIDEST * radius);
    return areNear(larger.points, smaller.points, limit);
  };
  const findPair = (): [Part, Part] | undefined => {
    for (const [place, larger] of parts.entries()) {
      const known = apart.get(larger) ?? new Set();
      apart.set(larger, known);
      for (const smaller of parts.slice(place + 1)) {
        if (known.has(smaller)) continue;
        if (belongTogether(larger, smaller)) return [larger, smaller];
        known.add(smaller);
      }
    }
    return undefined;
  };
  for (let pair = findPair(); pair; pair = findPair()) {
    const [larger, smaller] = pair;
    const joined = makePart(points, [...larger.rows, ...smaller.rows]);
    parts = [...parts.filter((part) => part !== larger && part !== smaller), joined];
    parts.sort((a, b) => bySize(a.rows, b.rows));
  }
  for (const { rows } of parts) {
    const label = rows.reduce((least, row) => Math.min(least, labels[row] ?? least), Infinity);
    for (const row of rows) labels[row] = label;
  }
  return labels;
}

/** The clusters of the Gaussians at or above a threshold, best first. */
export function findClusters(
  relevancy: Float32Array,
  threshold: number,
  means: Float32Array,
  weight: (row: number) => number,
  settings: LocalizeSettings,
): Cluster[] {
  const picked: number[] = [];
  for (let row = 0; row < relevancy.length; row++) {
    if ((relevancy[row] ?? NaN) >= threshold && weight(row) > settings.minWeight) picked.push(row);
  }
  const points = new Float32Array(3 * picked.length);
  picked.forEach((row, place) => points.set(means.subarray(3 * row, 3 * row + 3), 3 * place));
  const labels = (settings.followsGaps ? labelsByGaps : labelsOf)(points, settings.eps, settings.minSamples);
  const groups = new Map<number, number[]>();
  let total = 0;
  picked.forEach((row, place) => {
    total += weight(row);
    const label = labels[place] ?? -1;
    if (label < 0) return;
    const group = groups.get(label);
    if (group) group.push(row);
    else groups.set(label, [row]);
  });
  const clusters = [...groups.values()].map((rows) => {
    let sum = 0;
    let mean = 0;
    for (const row of rows) {
      sum += weight(row);
      mean += weight(row) * (relevancy[row] ?? 0);
    }
    mean /= sum;
    const damping = (sum / total) ** 0.25;
    return { rows: Int32Array.from(rows), score: mean >= 0 ? mean * damping : mean / damping, share: sum / total };
  });
  clusters.sort((a, b) => b.score - a.score || (a.rows[0] ?? 0) - (b.rows[0] ?? 0));
  const least = settings.minShare * (clusters[0]?.share ?? 0);
  return clusters.filter((each) => each.share >= least).slice(0, settings.maxBoxes);
}
