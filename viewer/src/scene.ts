// A scene: what it is made of, and the geometry of its Gaussians once the splat has been read.

import { arrayOf, type Container } from "./container";
import type { SceneMeta } from "./types";

export interface View {
  name: string;
  center: [number, number, number];
  /** Rows of the rotation from the world into the axes of the camera: right, down, forward. */
  rotation: number[];
  translation: [number, number, number];
  fx: number;
  fy: number;
  cx: number;
  cy: number;
  width: number;
  height: number;
}

/** The Gaussians as arrays, in the scene's coordinates. */
export interface Geometry {
  count: number;
  means: Float32Array;
  scales: Float32Array;
  /** xyzw */
  quats: Float32Array;
  opacities: Float32Array;
}

export class Scene {
  readonly meta: SceneMeta;
  readonly splat: Uint8Array;
  readonly pca: Uint8Array;
  readonly weightCodes: Uint8Array;
  readonly objects: Uint16Array | null;
  readonly views: View[];
  geometry: Geometry | null = null;

  constructor(container: Container<SceneMeta>) {
    this.meta = container.meta;
    this.splat = arrayOf(container, "splat", Uint8Array);
    this.pca = arrayOf(container, "pca", Uint8Array);
    this.weightCodes = arrayOf(container, "weights", Uint8Array);
    this.objects = container.arrays.has("objects") ? arrayOf(container, "objects", Uint16Array) : null;
    this.views = container.arrays.has("Ks") ? viewsOf(container) : [];
  }

  get count(): number {
    return this.meta.count;
  }

  /** The visibility weight of a Gaussian, 0 where it was never seen. */
  weight(row: number): number {
    const code = this.weightCodes[row] ?? 0;
    if (code === 0) return 0;
    const [low, high] = this.meta.weights;
    return low * (high / low) ** ((code - 1) / 254);
  }

  get up(): [number, number, number] {
    return this.meta.up ?? [0, 0, 1];
  }
}

function viewsOf(container: Container<SceneMeta>): View[] {
  const poses = arrayOf(container, "camFromWorld", Float32Array);
  const Ks = arrayOf(container, "Ks", Float32Array);
  const sizes = arrayOf(container, "sizes", Int32Array);
  return container.meta.views.map((name, index) => {
    const pose = poses.subarray(16 * index, 16 * index + 16) as ArrayLike<number> as number[];
    const at = (row: number, column: number): number => pose[4 * row + column] ?? 0;
    const rotation = [at(0, 0), at(0, 1), at(0, 2), at(1, 0), at(1, 1), at(1, 2), at(2, 0), at(2, 1), at(2, 2)];
    const t: [number, number, number] = [at(0, 3), at(1, 3), at(2, 3)];
    const back = (axis: number): number => -(at(0, axis) * t[0] + at(1, axis) * t[1] + at(2, axis) * t[2]);
    const K = (place: number): number => Ks[9 * index + place] ?? 0;
    return {
      name,
      center: [back(0), back(1), back(2)],
      rotation,
      translation: t,
      fx: K(0),
      fy: K(4),
      cx: K(2),
      cy: K(5),
      width: sizes[2 * index] ?? 1,
      height: sizes[2 * index + 1] ?? 1,
    };
  });
}

/** Pixel and depth of a point in a view. */
export function project(view: View, x: number, y: number, z: number): [number, number, number] {
  const r = view.rotation as [number, number, number, number, number, number, number, number, number];
  const t = view.translation;
  const depth = r[6] * x + r[7] * y + r[8] * z + t[2];
  const u = (view.fx * (r[0] * x + r[1] * y + r[2] * z + t[0])) / depth + view.cx;
  const v = (view.fy * (r[3] * x + r[4] * y + r[5] * z + t[1])) / depth + view.cy;
  return [u, v, depth];
}
