// When frames are drawn: on demand, one at a time, and once more, finely, when nothing moves.

/** Milliseconds without a move after which the picture is drawn finely. */
const REST = 220;

export class Frames {
  /** Milliseconds that the last frame took until it was drawn. */
  last = 0;
  private drawing = false;
  private wanted = false;
  private readonly waiting: (() => void)[] = [];
  private time = 0;
  private lastMove = -Infinity;
  private resting: ReturnType<typeof setTimeout> | undefined;

  /** `step` moves the camera by a number of seconds and tells whether it does; `render` tells whether all is drawn finely. */
  constructor(
    private readonly step: (seconds: number) => boolean,
    private readonly render: (moving: boolean) => Promise<boolean>,
  ) {}

  /** Something changed, so that a frame is needed. */
  dirty(): void {
    this.wanted = true;
    if (this.drawing) return;
    this.drawing = true;
    requestAnimationFrame((now) => void this.draw(now));
  }

  /** The camera moved. */
  moved(): void {
    this.lastMove = performance.now();
    this.dirty();
  }

  /** Draws a frame, and resolves when it is drawn. */
  frame(): Promise<void> {
    return new Promise((resolve) => {
      this.waiting.push(resolve);
      this.dirty();
    });
  }

  /** What cannot keep up draws less often, and never falls behind. */
  private async draw(now: number): Promise<void> {
    this.wanted = false;
    const waiting = this.waiting.splice(0);
    const moved = this.step(Math.min(0.1, (now - this.time) / 1000));
    this.time = now;
    if (moved) this.lastMove = now;
    const begin = performance.now();
    const fine = await this.render(begin - this.lastMove < REST);
    this.last = performance.now() - begin;
    this.drawing = false;
    for (const resolve of waiting) resolve();
    if (moved || this.wanted) this.dirty();
    else if (!fine) {
      clearTimeout(this.resting);
      this.resting = setTimeout(() => this.dirty(), REST);
    }
  }
}
