// Which Gaussian a ray shows most of, and how much of a point a view sees.

import { project, type Geometry, type View } from "./scene";

const OPAQUE = 1 / 255;

export interface Hit {
  row: number;
  depth: number;
  /** Share of the ray's color that this Gaussian gives. */
  weight: number;
}

interface Crossing {
  row: number;
  depth: number;
  alpha: number;
}

/** The Gaussians that a ray meets, near to far, by their largest response along it. */
function crossings(geometry: Geometry, origin: ArrayLike<number>, direction: ArrayLike<number>, far: number): Crossing[] {
  const [ox, oy, oz] = [origin[0] ?? 0, origin[1] ?? 0, origin[2] ?? 0];
  const [dx, dy, dz] = [direction[0] ?? 0, direction[1] ?? 0, direction[2] ?? 0];
  const { means, scales, quats, opacities, count } = geometry;
  const list: Crossing[] = [];
  for (let row = 0; row < count; row++) {
    const x = (means[3 * row] as number) - ox;
    const y = (means[3 * row + 1] as number) - oy;
    const z = (means[3 * row + 2] as number) - oz;
    const along = x * dx + y * dy + z * dz;
    if (along <= 0 || along > far) continue;
    const s0 = scales[3 * row] as number;
    const s1 = scales[3 * row + 1] as number;
    const s2 = scales[3 * row + 2] as number;
    const reach = 3 * Math.max(s0, s1, s2);
    if (x * x + y * y + z * z - along * along > reach * reach) continue;
    // The ray in the axes of the Gaussian, where it is a unit ball.
    const qx = quats[4 * row] as number;
    const qy = quats[4 * row + 1] as number;
    const qz = quats[4 * row + 2] as number;
    const qw = quats[4 * row + 3] as number;
    const r00 = 1 - 2 * (qy * qy + qz * qz);
    const r10 = 2 * (qx * qy + qw * qz);
    const r20 = 2 * (qx * qz - qw * qy);
    const r01 = 2 * (qx * qy - qw * qz);
    const r11 = 1 - 2 * (qx * qx + qz * qz);
    const r21 = 2 * (qy * qz + qw * qx);
    const r02 = 2 * (qx * qz + qw * qy);
    const r12 = 2 * (qy * qz - qw * qx);
    const r22 = 1 - 2 * (qx * qx + qy * qy);
    // Flat Gaussians have a scale of nearly zero.
    const i0 = 1 / Math.max(s0, 1e-7);
    const i1 = 1 / Math.max(s1, 1e-7);
    const i2 = 1 / Math.max(s2, 1e-7);
    const p0 = i0 * (r00 * x + r10 * y + r20 * z);
    const p1 = i1 * (r01 * x + r11 * y + r21 * z);
    const p2 = i2 * (r02 * x + r12 * y + r22 * z);
    const v0 = i0 * (r00 * dx + r10 * dy + r20 * dz);
    const v1 = i1 * (r01 * dx + r11 * dy + r21 * dz);
    const v2 = i2 * (r02 * dx + r12 * dy + r22 * dz);
    const pv = p0 * v0 + p1 * v1 + p2 * v2;
    const vv = v0 * v0 + v1 * v1 + v2 * v2;
    const distance = Math.max(0, p0 * p0 + p1 * p1 + p2 * p2 - (pv * pv) / vv);
    const alpha = Math.min(0.99, (opacities[row] as number) * Math.exp(-0.5 * distance));
    if (alpha < OPAQUE) continue;
    list.push({ row, depth: pv / vv, alpha });
  }
  return list.sort((a, b) => a.depth - b.depth);
}

/** The Gaussian with the largest compositing weight T·α on a ray; null where the ray meets none. */
export function pick(geometry: Geometry, origin: ArrayLike<number>, direction: ArrayLike<number>): Hit | null {
  let best: Hit | null = null;
  let transmittance = 1;
  for (const each of crossings(geometry, origin, direction, Infinity)) {
    const weight = transmittance * each.alpha;
    if (!best || weight > best.weight) best = { row: each.row, depth: each.depth, weight };
    transmittance *= 1 - each.alpha;
    if (transmittance < 1e-3) break;
  }
  return best && best.weight > 0.02 ? best : null;
}

export interface SeenView {
  view: number;
  score: number;
}

const JUDGED = 12;

/** The views that show a ball best: in the picture, large but not cut off, and not hidden. */
export function bestViews(
  views: View[],
  geometry: Geometry,
  center: ArrayLike<number>,
  radius: number,
  count: number,
): SeenView[] {
  const [x, y, z] = [center[0] ?? 0, center[1] ?? 0, center[2] ?? 0];
  const inside: SeenView[] = [];
  views.forEach((view, number) => {
    const [u, v, depth] = project(view, x, y, z);
    if (depth <= 0 || u < 0 || v < 0 || u >= view.width || v >= view.height) return;
    const edge = Math.min(u, view.width - u, v, view.height - v) / Math.min(view.width, view.height);
    const share = Math.min(1, (view.fx * radius) / depth / (0.35 * view.width));
    inside.push({ view: number, score: (0.2 + share) * (0.4 + Math.min(edge, 0.3)) });
  });
  inside.sort((a, b) => b.score - a.score);
  const judged = inside.slice(0, JUDGED).map(({ view, score }) => {
    const from = views[view]?.center ?? [0, 0, 0];
    const ray = [x - from[0], y - from[1], z - from[2]];
    const length = Math.hypot(...ray);
    const direction = ray.map((value) => value / length);
    let visible = 1;
    for (const each of crossings(geometry, from, direction, length)) {
      if (each.depth < length - 1.2 * radius) visible *= 1 - each.alpha;
    }
    return { view, score: score * visible };
  });
  return judged
    .filter((each) => each.score > 0.02)
    .sort((a, b) => b.score - a.score)
    .slice(0, count);
}
