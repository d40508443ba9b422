// One scene on one canvas, drawn with Spark; boxes and cameras over it.

import { RgbaArray, SplatFileType, SplatMesh } from "@sparkjsdev/spark";
import * as THREE from "three";
import { BatchedSpark } from "./batched_spark";
import type { Controls } from "./controls";
import { Overlay, type ShownBox } from "./overlay";
import { pick, type Hit } from "./picking";
import { Quality, drawn, rendererName } from "./quality";
import type { Geometry, Scene } from "./scene";
import type { FoundBox } from "./types";

const BACKGROUND = 0x17181b;
const VIEW_RADIUS = 12;

export class Pane {
  readonly element = document.createElement("div");
  readonly canvas = document.createElement("canvas");
  /** Colors of the splat itself, with its opacities. */
  base = new Uint8Array();
  /** Where the scene lies in the world of the first one. */
  readonly offset = new THREE.Vector3();
  size = 1;
  private readonly renderer: THREE.WebGLRenderer;
  private readonly spark: BatchedSpark;
  private readonly world = new THREE.Scene();
  private readonly group = new THREE.Group();
  private readonly camera = new THREE.PerspectiveCamera();
  private readonly gl: WebGL2RenderingContext;
  private readonly quality: Quality;
  private mesh: SplatMesh | null = null;
  private readonly rgba = new RgbaArray();
  private readonly overlay: Overlay;

  constructor(
    readonly scene: Scene,
    private readonly dirty: () => void,
    boxClicked: (box: FoundBox) => void,
  ) {
    this.element.className = "pane";
    this.overlay = new Overlay(boxClicked);
    const title = document.createElement("div");
    title.className = "title";
    title.textContent = scene.meta.title;
    this.element.append(this.canvas, this.overlay.element, title);
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
    this.overlay.setViews(this.scene.views, 0.05 * this.size);
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
    this.overlay.camerasShown = shown;
    this.drawOverlay();
  }

  showBoxes(boxes: ShownBox[]): void {
    this.overlay.setBoxes(boxes);
    this.drawOverlay();
  }

  /** Over the frame that is shown; the splat is not drawn again. */
  private drawOverlay(): void {
    this.overlay.draw(this.camera, this.offset, this.element.clientWidth, this.element.clientHeight);
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
    const begin = performance.now();
    this.renderer.render(this.world, this.camera);
    this.drawOverlay();
    await drawn(this.gl);
    this.quality.measured(performance.now() - begin, width * height * ratio * ratio);
    return ratio >= this.quality.ratio(width * height, false);
  }

  /** The view whose camera is drawn near a place of the canvas. */
  viewAt(x: number, y: number): number | null {
    if (!this.overlay.camerasShown) return null;
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
