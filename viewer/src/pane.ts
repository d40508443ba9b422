// One scene on one canvas, drawn with Spark; boxes and cameras over it.

import { RgbaArray, SplatFileType, SplatMesh } from "@sparkjsdev/spark";
import * as THREE from "three";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";
import { BatchedSpark } from "./batched_spark";
import type { Controls } from "./controls";
import { pick, type Hit } from "./picking";
import { Quality, drawn, rendererName } from "./quality";
import type { Geometry, Scene } from "./scene";
import type { FoundBox } from "./types";

const BACKGROUND = 0x17181b;
const BOX_COLOR = 0xffd166;
const CHOSEN_COLOR = 0xffffff;
const CAMERA_COLOR = 0x6f7a8a;
const VIEW_RADIUS = 12;

export interface ShownBox {
  box: FoundBox;
  label: string;
  chosen: boolean;
  /** Not judged yet. */
  provisional: boolean;
}

export class Pane {
  readonly element = document.createElement("div");
  readonly canvas = document.createElement("canvas");
  /** Colors of the splat itself, with its opacities. */
  base = new Uint8Array();
  /** Where the scene lies in the world of the first one. */
  readonly offset = new THREE.Vector3();
  size = 1;
  private readonly labels = document.createElement("div");
  private readonly renderer: THREE.WebGLRenderer;
  private readonly spark: BatchedSpark;
  private readonly world = new THREE.Scene();
  private readonly group = new THREE.Group();
  private readonly camera = new THREE.PerspectiveCamera();
  private readonly gl: WebGL2RenderingContext;
  private readonly quality: Quality;
  private mesh: SplatMesh | null = null;
  private readonly rgba = new RgbaArray();
  private lines: LineSegments2[] = [];
  private frusta: THREE.LineSegments | null = null;
  private boxes: ShownBox[] = [];

  constructor(
    readonly scene: Scene,
    private readonly dirty: () => void,
    private readonly boxClicked: (box: FoundBox) => void,
  ) {
    this.element.className = "pane";
    this.labels.className = "labels";
    const title = document.createElement("div");
    title.className = "title";
    title.textContent = scene.meta.title;
    this.element.append(this.canvas, this.labels, title);
    this.renderer = new THREE.WebGLRenderer({ canvas: this.canvas, antialias: false, preserveDrawingBuffer: true });
    this.gl = this.renderer.getContext() as WebGL2RenderingContext;
    this.quality = new Quality(Math.min(window.devicePixelRatio, 2), rendererName(this.gl));
    this.world.background = new THREE.Color(BACKGROUND);
    this.spark = new BatchedSpark({ renderer: this.renderer, enableLod: false, onDirty: dirty });
    this.world.add(this.spark, this.group);
  }

  async load(): Promise<void> {
    const mesh = new SplatMesh({ fileBytes: this.scene.splat, fileType: SplatFileType.SPZ, extSplats: true });
    this.mesh = mesh;
    await mesh.initialized;
    const { count } = this.scene;
    if (mesh.numSplats !== count) throw new Error(`The splat holds ${mesh.numSplats} Gaussians instead of ${count}.`);
    const geometry: Geometry = {
      count,
      means: new Float32Array(3 * count),
      scales: new Float32Array(3 * count),
      quats: new Float32Array(4 * count),
      opacities: new Float32Array(count),
    };
    this.base = new Uint8Array(4 * count);
    const byte = (value: number): number => Math.max(0, Math.min(255, Math.round(255 * value)));
    mesh.forEachSplat((row, center, scales, quaternion, opacity, color) => {
      center.toArray(geometry.means, 3 * row);
      scales.toArray(geometry.scales, 3 * row);
      quaternion.toArray(geometry.quats, 4 * row);
      geometry.opacities[row] = opacity;
      this.base.set([byte(color.r), byte(color.g), byte(color.b), byte(opacity)], 4 * row);
    });
    this.scene.geometry = geometry;
    this.rgba.ensureCapacity(count).set(this.base);
    this.rgba.count = count;
    this.size = extentOf(geometry);
    this.group.add(mesh);
    this.group.position.copy(this.offset);
    this.frusta = frustaOf(this.scene, 0.05 * this.size);
    if (this.frusta) this.group.add(this.frusta);
  }

  /** Colors each Gaussian; null = the splat's own colors, with spherical harmonics. */
  paint(write: ((rgba: Uint8Array) => void) | null): void {
    const mesh = this.mesh;
    if (!mesh || !this.rgba.array) return;
    if (write) {
      write(this.rgba.array);
      this.rgba.needsUpdate = true;
    }
    const wanted = write ? this.rgba : null;
    if (mesh.splatRgba !== wanted) {
      mesh.splatRgba = wanted;
      mesh.updateGenerator();
    }
    mesh.updateVersion();
    this.dirty();
  }

  showCameras(shown: boolean): void {
    if (this.frusta) this.frusta.visible = shown;
    this.dirty();
  }

  showBoxes(boxes: ShownBox[]): void {
    for (const line of this.lines) {
      this.group.remove(line);
      line.geometry.dispose();
      line.material.dispose();
    }
    this.lines = [];
    this.boxes = boxes;
    this.labels.replaceChildren();
    for (const shown of boxes) {
      const line = linesOf(shown);
      this.lines.push(line);
      this.group.add(line);
      const label = document.createElement("button");
      label.type = "button";
      label.className = shown.chosen ? "label chosen" : shown.provisional ? "label provisional" : "label";
      label.textContent = shown.label;
      label.addEventListener("click", () => this.boxClicked(shown.box));
      this.labels.append(label);
    }
    this.dirty();
  }

  /** Draws a frame, and resolves when it is drawn, to whether it was as fine as a resting picture can be. */
  async render(controls: Controls, moving: boolean): Promise<boolean> {
    const { clientWidth: width, clientHeight: height } = this.element;
    if (!width || !height) return true;
    const ratio = this.quality.ratio(width * height, moving);
    const now = this.renderer.getSize(new THREE.Vector2());
    if (ratio !== this.renderer.getPixelRatio()) this.renderer.setPixelRatio(ratio);
    if (now.x !== width || now.y !== height) this.renderer.setSize(width, height, false);
    controls.apply(this.camera, width / height, this.size);
    for (const line of this.lines) line.material.resolution.set(width, height);
    const begin = performance.now();
    this.renderer.render(this.world, this.camera);
    this.placeLabels(width, height);
    await drawn(this.gl);
    this.quality.measured(performance.now() - begin, width * height * ratio * ratio);
    return ratio >= this.quality.ratio(width * height, false);
  }

  /** The view whose camera is drawn near a place of the canvas. */
  viewAt(x: number, y: number): number | null {
    if (!this.frusta?.visible) return null;
    let best: number | null = null;
    let least = VIEW_RADIUS;
    this.scene.views.forEach((view, number) => {
      const place = this.place(new THREE.Vector3(...view.center));
      if (!place) return;
      const distance = Math.hypot(place.x - x, place.y - y);
      if (distance < least) {
        least = distance;
        best = number;
      }
    });
    return best;
  }

  /** The Gaussian at a place of the canvas. */
  pickAt(x: number, y: number): Hit | null {
    const geometry = this.scene.geometry;
    if (!geometry) return null;
    const ndc = new THREE.Vector2((2 * x) / this.element.clientWidth - 1, 1 - (2 * y) / this.element.clientHeight);
    const ray = new THREE.Raycaster();
    ray.setFromCamera(ndc, this.camera);
    return pick(geometry, ray.ray.origin.clone().sub(this.offset).toArray(), ray.ray.direction.toArray());
  }

  /** The Gaussian along a ray of the scene. */
  hit(from: ArrayLike<number>, direction: ArrayLike<number>): Hit | null {
    return this.scene.geometry ? pick(this.scene.geometry, from, direction) : null;
  }

  /** The place on the canvas of a point of the scene; null behind the camera. */
  place(point: THREE.Vector3): { x: number; y: number } | null {
    const seen = point.clone().add(this.offset).project(this.camera);
    if (seen.z > 1 || seen.z < -1) return null;
    return {
      x: ((seen.x + 1) / 2) * this.element.clientWidth,
      y: ((1 - seen.y) / 2) * this.element.clientHeight,
    };
  }

  private placeLabels(width: number, height: number): void {
    this.boxes.forEach(({ box }, number) => {
      const label = this.labels.children[number];
      if (!(label instanceof HTMLElement)) return;
      // At the corner that is highest on the canvas.
      const places = cornersOf(box).flatMap((corner) => this.place(corner) ?? []);
      const top = places.reduce<{ x: number; y: number } | null>((a, b) => (a && a.y <= b.y ? a : b), null);
      const shown = top && top.x > -20 && top.x < width + 20 && top.y < height + 20;
      label.style.display = shown ? "" : "none";
      if (shown) label.style.transform = `translate(${top.x.toFixed(1)}px, ${Math.max(24, top.y).toFixed(1)}px)`;
    });
  }
}

export function cornersOf(box: FoundBox): THREE.Vector3[] {
  const r = box.rotation;
  return Array.from({ length: 8 }, (_, corner) => {
    const half = box.size.map((side, axis) => (corner & (1 << axis) ? side / 2 : -side / 2));
    const at = (k: number): number =>
      (box.center[k] ?? 0) + [0, 1, 2].reduce((sum, axis) => sum + (r[3 * k + axis] ?? 0) * (half[axis] ?? 0), 0);
    return new THREE.Vector3(at(0), at(1), at(2));
  });
}

function linesOf({ box, chosen, provisional }: ShownBox): LineSegments2 {
  const corners = cornersOf(box);
  const points: number[] = [];
  for (let a = 0; a < 8; a++) {
    for (const bit of [1, 2, 4]) {
      if (!(a & bit)) points.push(...(corners[a]?.toArray() ?? []), ...(corners[a | bit]?.toArray() ?? []));
    }
  }
  const material = new LineMaterial({
    color: chosen ? CHOSEN_COLOR : BOX_COLOR,
    linewidth: chosen ? 3 : box.rank === 0 ? 2.2 : 1.4,
    depthTest: false,
    transparent: true,
    opacity: provisional ? 0.55 : 1,
  });
  const lines = new LineSegments2(new LineSegmentsGeometry().setPositions(points), material);
  // After the splat.
  lines.renderOrder = 10;
  return lines;
}

function frustaOf(scene: Scene, depth: number): THREE.LineSegments | null {
  if (!scene.views.length) return null;
  const points: number[] = [];
  for (const view of scene.views) {
    const r = view.rotation as [number, number, number, number, number, number, number, number, number];
    const corner = (u: number, v: number): number[] => {
      const x = ((u - view.cx) / view.fx) * depth;
      const y = ((v - view.cy) / view.fy) * depth;
      return [0, 1, 2].map(
        (axis) => view.center[axis as 0] + (r[axis] ?? 0) * x + (r[3 + axis] ?? 0) * y + (r[6 + axis] ?? 0) * depth,
      );
    };
    const [a, b] = [corner(0, 0), corner(view.width, 0)];
    const [c, d] = [corner(view.width, view.height), corner(0, view.height)];
    for (const each of [a, b, c, d]) points.push(...view.center, ...each);
    points.push(...a, ...b, ...b, ...c, ...c, ...d, ...d, ...a);
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(points, 3));
  const material = new THREE.LineBasicMaterial({ color: CAMERA_COLOR, depthTest: false, transparent: true, opacity: 0.8 });
  const lines = new THREE.LineSegments(geometry, material);
  lines.renderOrder = 5;
  return lines;
}

/** How large the middle nine tenths of the means are, along the longest axis. */
function extentOf(geometry: Geometry): number {
  const step = Math.max(1, Math.floor(geometry.count / 20000));
  let longest = 0;
  for (let axis = 0; axis < 3; axis++) {
    const values: number[] = [];
    for (let row = 0; row < geometry.count; row += step) values.push(geometry.means[3 * row + axis] ?? 0);
    values.sort((a, b) => a - b);
    const at = (share: number): number => values[Math.floor(share * (values.length - 1))] ?? 0;
    longest = Math.max(longest, at(0.95) - at(0.05));
  }
  return longest || 1;
}

/** Whether the browser draws with WebGL 2. */
export function hasWebGL(): boolean {
  try {
    return document.createElement("canvas").getContext("webgl2") !== null;
  } catch {
    return false;
  }
}
