// One camera for all panes: orbit about a point, or walk.

import * as THREE from "three";
import type { View } from "./scene";

export type Move = "orbit" | "walk";

const DEFAULT_FOV = 55;
/** Cosine of the angle to the up direction that the camera does not go beyond. */
const POLE = 0.995;
const CLICK_PIXELS = 4;
const ARROWS: Record<string, [number, number, number]> = {
  KeyW: [0, 0, -1], ArrowUp: [0, 0, -1], KeyS: [0, 0, 1], ArrowDown: [0, 0, 1],
  KeyA: [-1, 0, 0], ArrowLeft: [-1, 0, 0], KeyD: [1, 0, 0], ArrowRight: [1, 0, 0],
  KeyQ: [0, -1, 0], KeyE: [0, 1, 0],
};

export class Controls {
  move: Move = "orbit";
  readonly position = new THREE.Vector3();
  readonly quaternion = new THREE.Quaternion();
  /** From the camera to the point that it orbits. */
  distance = 1;
  /** Half the tangents that must be in the picture, and the vertical field of view where nothing must. */
  private fit: { x: number; y: number } | null = null;
  private readonly keys = new Set<string>();
  private readonly pointers = new Map<number, { x: number; y: number }>();
  private travelled = 0;

  constructor(
    private readonly up: THREE.Vector3,
    private speed: number,
    private readonly changed: () => void,
  ) {
    window.addEventListener("keydown", (event) => {
      if (event.target instanceof HTMLInputElement || event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.code in ARROWS) {
        this.keys.add(event.code);
        event.preventDefault();
        this.changed();
      }
    });
    window.addEventListener("keyup", (event) => this.keys.delete(event.code));
    window.addEventListener("blur", () => this.keys.clear());
  }

  /** Listens on the canvas of a pane; `clicked` gets the place of a click that was no drag. */
  listen(canvas: HTMLCanvasElement, clicked: (x: number, y: number) => void): void {
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      this.travelled = 0;
      if (document.activeElement instanceof HTMLElement) document.activeElement.blur();
    });
    canvas.addEventListener("pointermove", (event) => {
      const last = this.pointers.get(event.pointerId);
      if (!last) return;
      const [dx, dy] = [event.clientX - last.x, event.clientY - last.y];
      this.travelled += Math.hypot(dx, dy);
      if (this.pointers.size > 1) this.pinch(event.pointerId, event.clientX, event.clientY);
      else if (event.buttons & 2 || event.shiftKey) this.pan(dx, dy, canvas.clientHeight);
      else this.turn((-dx * 2.4) / canvas.clientHeight, (-dy * 2.4) / canvas.clientHeight);
      last.x = event.clientX;
      last.y = event.clientY;
    });
    const ended = (event: PointerEvent): void => {
      if (!this.pointers.delete(event.pointerId)) return;
      if (event.type === "pointerup" && event.button === 0 && this.travelled < CLICK_PIXELS) {
        const corner = canvas.getBoundingClientRect();
        clicked(event.clientX - corner.left, event.clientY - corner.top);
      }
    };
    canvas.addEventListener("pointerup", ended);
    canvas.addEventListener("pointercancel", ended);
    canvas.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        this.zoom(Math.exp(Math.max(-1, Math.min(1, event.deltaY / 400))));
      },
      { passive: false },
    );
  }

  /** Moves by the pressed keys; true while any is pressed. */
  step(seconds: number, fast: boolean): boolean {
    if (!this.keys.size) return false;
    const direction = new THREE.Vector3();
    for (const key of this.keys) {
      const [x, y, z] = ARROWS[key] ?? [0, 0, 0];
      direction.add(new THREE.Vector3(x, 0, z).applyQuaternion(this.quaternion)).addScaledVector(this.up, y);
    }
    if (direction.lengthSq()) this.position.addScaledVector(direction.normalize(), this.speed * seconds * (fast ? 3 : 1));
    return true;
  }

  forward(): THREE.Vector3 {
    return new THREE.Vector3(0, 0, -1).applyQuaternion(this.quaternion);
  }

  target(): THREE.Vector3 {
    return this.position.clone().addScaledVector(this.forward(), this.distance);
  }

  lookFrom(position: THREE.Vector3, target: THREE.Vector3): void {
    this.position.copy(position);
    this.distance = Math.max(1e-6, position.distanceTo(target));
    this.quaternion.setFromRotationMatrix(new THREE.Matrix4().lookAt(position, target, this.up));
    this.fit = null;
    this.changed();
  }

  /** Looks at a point from where the camera is, or from nearer where it is far. */
  lookAt(target: THREE.Vector3, distance: number): void {
    const away = this.position.clone().sub(target);
    if (!away.lengthSq()) away.copy(this.forward()).negate();
    this.lookFrom(target.clone().add(away.setLength(Math.min(away.length(), distance))), target);
  }

  /** Stands where a view was taken from; the whole picture is seen. */
  stand(view: View, distance: number): void {
    this.position.set(...view.center);
    const r = view.rotation as [number, number, number, number, number, number, number, number, number];
    // Columns: right, up, backward.
    const m = new THREE.Matrix4().set(
      r[0], -r[3], -r[6], 0,
      r[1], -r[4], -r[7], 0,
      r[2], -r[5], -r[8], 0,
      0, 0, 0, 1,
    );
    this.quaternion.setFromRotationMatrix(m);
    this.distance = distance;
    this.fit = { x: view.width / 2 / view.fx, y: view.height / 2 / view.fy };
    this.changed();
  }

  apply(camera: THREE.PerspectiveCamera, aspect: number, size: number): void {
    camera.position.copy(this.position);
    camera.quaternion.copy(this.quaternion);
    const tangent = this.fit
      ? Math.max(this.fit.y, this.fit.x / aspect)
      : Math.tan((DEFAULT_FOV / 2) * (Math.PI / 180)) * Math.max(1, 0.8 / aspect);
    camera.fov = (2 * Math.atan(tangent) * 180) / Math.PI;
    camera.aspect = aspect;
    camera.near = size * 1e-3;
    camera.far = size * 100;
    camera.updateProjectionMatrix();
    camera.updateMatrixWorld();
  }

  private turn(yaw: number, pitch: number): void {
    const target = this.target();
    const turned = new THREE.Quaternion()
      .setFromAxisAngle(this.up, yaw)
      .multiply(this.quaternion)
      .multiply(new THREE.Quaternion().setFromAxisAngle(new THREE.Vector3(1, 0, 0), pitch));
    const steep = Math.abs(new THREE.Vector3(0, 0, -1).applyQuaternion(turned).dot(this.up));
    if (steep > POLE && steep > Math.abs(this.forward().dot(this.up))) return;
    this.quaternion.copy(turned.normalize());
    if (this.move === "orbit") this.position.copy(target).addScaledVector(this.forward(), -this.distance);
    this.changed();
  }

  private pan(dx: number, dy: number, height: number): void {
    const scale = (1.1 * this.distance) / height;
    this.position.add(new THREE.Vector3(-dx * scale, dy * scale, 0).applyQuaternion(this.quaternion));
    this.changed();
  }

  private zoom(factor: number): void {
    if (this.move === "orbit") {
      const target = this.target();
      this.distance *= factor;
      this.position.copy(target).addScaledVector(this.forward(), -this.distance);
    } else {
      this.position.addScaledVector(this.forward(), (1 - factor) * this.speed);
    }
    this.changed();
  }

  private pinch(id: number, x: number, y: number): void {
    const [other] = [...this.pointers].filter(([key]) => key !== id).map(([, place]) => place);
    const last = this.pointers.get(id);
    if (!other || !last) return;
    const before = Math.hypot(last.x - other.x, last.y - other.y);
    const now = Math.hypot(x - other.x, y - other.y);
    if (now > 0 && before > 0) this.zoom(before / now);
  }
}
