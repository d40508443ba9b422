// The resolution that the machine draws in time: coarser while the camera moves, finer when it rests.

/** Milliseconds that a frame may take while something moves, and when nothing does. */
const MOVING = 60;
const RESTING = 900;
const LEAST_RATIO = 0.2;
/** Milliseconds a megapixel that are assumed before the first measurement. */
const GUESS = { hardware: 8, software: 4000 };
const SOFTWARE = /swiftshader|llvmpipe|software|basic render/i;

export class Quality {
  private cost: number;

  constructor(private readonly highest: number, renderer: string) {
    this.cost = (SOFTWARE.test(renderer) ? GUESS.software : GUESS.hardware) / 1e6;
  }

  /** Drawn pixels for each pixel of the page, for a canvas of this number of pixels. */
  ratio(pixels: number, moving: boolean): number {
    const affordable = Math.sqrt((moving ? MOVING : RESTING) / this.cost / Math.max(1, pixels));
    // Steps, so that the canvas is not resized by a hair.
    const stepped = Math.floor(8 * affordable) / 8;
    return Math.max(LEAST_RATIO, Math.min(this.highest, stepped));
  }

  /** Learns from a frame: milliseconds until it was drawn, and its pixels. */
  measured(milliseconds: number, pixels: number): void {
    const cost = milliseconds / Math.max(1, pixels);
    // One slow frame, such as the first, is soon forgotten.
    this.cost = Math.exp(0.6 * Math.log(this.cost) + 0.4 * Math.log(Math.max(cost, 1e-9)));
  }
}

/** The name of what draws, as far as the browser tells. */
export function rendererName(gl: WebGLRenderingContext | WebGL2RenderingContext): string {
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  return String(gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER) ?? "");
}

/** Resolves when everything that was given to WebGL has been drawn. */
export async function drawn(gl: WebGL2RenderingContext): Promise<void> {
  const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
  if (!fence) return;
  gl.flush();
  for (;;) {
    await new Promise((resolve) => setTimeout(resolve, 2));
    const state = gl.clientWaitSync(fence, 0, 0);
    if (state !== gl.TIMEOUT_EXPIRED) break;
  }
  gl.deleteSync(fence);
}
