// Boxes and cameras, drawn over the splat at the full resolution of the screen, and the labels of boxes.

import * as THREE from "three";
import type { View } from "./scene";
import type { FoundBox } from "./types";

const BOX_COLOR = "#ffd166";
const CHOSEN_COLOR = "#ffffff";
const CAMERA_COLOR = "#8b95a6";
const SHADOW = "#17181baa";

export interface ShownBox {
  box: FoundBox;
  label: string;
  chosen: boolean;
}

type Segment = [THREE.Vector3, THREE.Vector3];
interface Place {
  x: number;
  y: number;
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

function edgesOf(box: FoundBox): Segment[] {
  const corners = cornersOf(box);
  return corners.flatMap((corner, number) =>
    [1, 2, 4].filter((bit) => !(number & bit)).map((bit): Segment => [corner, corners[number | bit] ?? corner]),
  );
}

function frustumOf(view: View, depth: number): Segment[] {
  const r = view.rotation;
  const center = new THREE.Vector3(...view.center);
  const corner = (u: number, v: number): THREE.Vector3 => {
    const [x, y] = [((u - view.cx) / view.fx) * depth, ((v - view.cy) / view.fy) * depth];
    const at = (axis: number): number => (r[axis] ?? 0) * x + (r[3 + axis] ?? 0) * y + (r[6 + axis] ?? 0) * depth;
    return center.clone().add(new THREE.Vector3(at(0), at(1), at(2)));
  };
  const { width, height } = view;
  const ring = [corner(0, 0), corner(width, 0), corner(width, height), corner(0, height)];
  return ring.flatMap((each, number): Segment[] => [
    [center, each],
    [each, ring[(number + 1) % 4] ?? each],
  ]);
}

export class Overlay {
  readonly element = document.createElement("div");
  private readonly canvas = document.createElement("canvas");
  private readonly labels = document.createElement("div");
  private boxes: { shown: ShownBox; edges: Segment[]; corners: THREE.Vector3[]; label: HTMLElement }[] = [];
  private cameras: Segment[] = [];
  camerasShown = false;

  constructor(private readonly clicked: (box: FoundBox) => void) {
    this.element.className = "overlay";
    this.labels.className = "labels";
    this.element.append(this.canvas, this.labels);
  }

  setViews(views: View[], depth: number): void {
    this.cameras = views.flatMap((view) => frustumOf(view, depth));
  }

  setBoxes(boxes: ShownBox[]): void {
    this.boxes = boxes.map((shown) => {
      const label = document.createElement("button");
      label.type = "button";
      label.className = shown.chosen ? "label chosen" : "label";
      label.textContent = shown.label;
      label.addEventListener("click", () => this.clicked(shown.box));
      return { shown, edges: edgesOf(shown.box), corners: cornersOf(shown.box), label };
    });
    this.labels.replaceChildren(...this.boxes.map(({ label }) => label));
  }

  /** Draws over a frame of the camera; `offset` leads from the scene into the camera's world. */
  draw(camera: THREE.PerspectiveCamera, offset: THREE.Vector3, width: number, height: number): void {
    const scale = Math.min(window.devicePixelRatio, 2);
    if (this.canvas.width !== Math.round(width * scale) || this.canvas.height !== Math.round(height * scale)) {
      this.canvas.width = Math.round(width * scale);
      this.canvas.height = Math.round(height * scale);
    }
    const context = this.canvas.getContext("2d");
    if (!context) return;
    context.setTransform(scale, 0, 0, scale, 0, 0);
    context.clearRect(0, 0, width, height);
    context.lineCap = "round";
    const view = camera.matrixWorldInverse.clone().multiply(new THREE.Matrix4().makeTranslation(offset));
    const place = (local: THREE.Vector3): Place => {
      const seen = local.clone().applyMatrix4(camera.projectionMatrix);
      return { x: ((seen.x + 1) / 2) * width, y: ((1 - seen.y) / 2) * height };
    };
    const path = (segments: Segment[]): Path2D => {
      const lines = new Path2D();
      for (const [from, to] of segments) {
        const clipped = inFront(from.clone().applyMatrix4(view), to.clone().applyMatrix4(view), camera.near);
        if (!clipped) continue;
        const [a, b] = [place(clipped[0]), place(clipped[1])];
        lines.moveTo(a.x, a.y);
        lines.lineTo(b.x, b.y);
      }
      return lines;
    };
    const stroke = (lines: Path2D, color: string, thickness: number): void => {
      context.strokeStyle = color;
      context.lineWidth = thickness;
      context.stroke(lines);
    };
    if (this.camerasShown) {
      const lines = path(this.cameras);
      stroke(lines, SHADOW, 2.5);
      stroke(lines, CAMERA_COLOR, 1);
    }
    // The chosen and the best ones lie over the others.
    for (const { shown, edges, corners, label } of [...this.boxes].reverse()) {
      const lines = path(edges);
      const thickness = shown.chosen ? 3 : shown.box.rank === 0 ? 2.2 : 1.5;
      stroke(lines, SHADOW, thickness + 2.5);
      stroke(lines, shown.chosen ? CHOSEN_COLOR : BOX_COLOR, thickness);
      const seen = corners.map((corner) => corner.clone().applyMatrix4(view)).filter((each) => each.z < -camera.near);
      const top = seen.map(place).reduce<Place | null>((a, b) => (a && a.y <= b.y ? a : b), null);
      const inside = top && top.x > 0 && top.x < width && top.y > -height / 2 && top.y < height;
      label.style.display = inside ? "" : "none";
      if (inside) label.style.transform = `translate(${top.x.toFixed(1)}px, ${Math.max(28, top.y).toFixed(1)}px)`;
    }
  }
}

/** The part of a segment of camera coordinates that lies in front of the camera. */
function inFront(from: THREE.Vector3, to: THREE.Vector3, near: number): Segment | null {
  const [a, b] = [-from.z - near, -to.z - near];
  if (a < 0 && b < 0) return null;
  if (a >= 0 && b >= 0) return [from, to];
  const cut = from.clone().lerp(to, a / (a - b));
  return a >= 0 ? [from, cut] : [cut, to];
}
