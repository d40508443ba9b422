// Spark with many splats an instance. Software renderers draw each instance by itself, which takes them most of the
// time, and graphics cards are not at their best with instances of four vertices either.

import { SparkRenderer, type SparkRendererOptions } from "@sparkjsdev/spark";
import * as THREE from "three";

/** Splats of an instance, 2 to the power of SHIFT; their corners must have 16-bit numbers. */
const SPLATS = 4096;
const SHIFT = 12;
const CORNERS = [-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0];
const TRIANGLES = [0, 1, 2, 0, 2, 3];
const BEGIN = "void main() {";

function batchGeometry(): THREE.InstancedBufferGeometry {
  const places = Array.from({ length: SPLATS }, (_, splat) => splat);
  const geometry = new THREE.InstancedBufferGeometry();
  const corners = new Float32Array(places.flatMap(() => CORNERS));
  const triangles = new Uint16Array(places.flatMap((splat) => TRIANGLES.map((corner) => 4 * splat + corner)));
  geometry.setAttribute("position", new THREE.BufferAttribute(corners, 3));
  geometry.setIndex(new THREE.BufferAttribute(triangles, 1));
  return geometry;
}

export class BatchedSpark extends SparkRenderer {
  private readonly active = { value: 0 };

  constructor(options: SparkRendererOptions) {
    super(options);
    const shader = this.material.vertexShader;
    if (!shader.includes("gl_InstanceID") || !shader.includes(BEGIN)) throw new Error("Spark's shader is another one.");
    this.material.vertexShader = shader
      .replaceAll("gl_InstanceID", "splatPlace")
      .replace(
        BEGIN,
        `uniform int activeSplats;\n${BEGIN}\n  int splatPlace = (gl_InstanceID << ${SHIFT}) | (gl_VertexID >> 2);\n` +
          "  if (splatPlace >= activeSplats) { gl_Position = vec4(0.0, 0.0, 2.0, 1.0); return; }\n",
      );
    this.material.uniforms.activeSplats = this.active;
    this.geometry.dispose();
    this.geometry = batchGeometry();
  }

  override onBeforeRender(renderer: THREE.WebGLRenderer, scene: THREE.Scene, camera: THREE.Camera): void {
    super.onBeforeRender(renderer, scene, camera);
    this.active.value = this.activeSplats;
    (this.geometry as THREE.InstancedBufferGeometry).instanceCount = Math.ceil(this.activeSplats / SPLATS);
  }
}
