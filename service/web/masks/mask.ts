// Pixels of a photo that do not count, as a user paints them.

export interface Place {
  readonly x: number;
  readonly y: number;
}

/** Red, green, blue and opacity of masked pixels over the photo. */
const SHOWN = new Uint32Array(new Uint8Array([255, 40, 140, 165]).buffer)[0]!;
const [BLACK, WHITE] = [0, 255].map((level) => new Uint32Array(new Uint8Array([level, level, level, 255]).buffer)[0]!) as [number, number];

export class Mask {
  /** As it is shown over the photo: a pixel is masked where it is not transparent. */
  private readonly picture: ImageData;
  private readonly pixels: Uint32Array;

  constructor(readonly width: number, readonly height: number, pixels?: Uint32Array) {
    this.picture = new ImageData(width, height);
    this.pixels = new Uint32Array(this.picture.data.buffer);
    if (pixels) this.pixels.set(pixels);
  }

  /** From a picture that is black where pixels do not count. */
  static of({ width, height, data }: ImageData): Mask {
    return new Mask(width, height, Uint32Array.from({ length: width * height }, (_, i) => (data[4 * i] ? 0 : SHOWN)));
  }

  copy(): Mask {
    return new Mask(this.width, this.height, this.pixels);
  }

  /** The share of the photo that is masked. */
  get share(): number {
    return this.pixels.reduce((sum, pixel) => sum + (pixel ? 1 : 0), 0) / this.pixels.length;
  }

  clear(): void {
    this.pixels.fill(0);
  }

  /** Masks what a round brush touches on its way, or takes it out of the mask. */
  stroke(from: Place, to: Place, radius: number, masked: boolean): void {
    const [dx, dy] = [to.x - from.x, to.y - from.y];
    const length2 = dx * dx + dy * dy;
    const within = (low: number, high: number, end: number) => [Math.max(0, Math.floor(low - radius)), Math.min(end, Math.ceil(high + radius))] as const;
    const [left, right] = within(Math.min(from.x, to.x), Math.max(from.x, to.x), this.width);
    const [top, bottom] = within(Math.min(from.y, to.y), Math.max(from.y, to.y), this.height);
    for (let y = top; y < bottom; y++) {
      for (let x = left; x < right; x++) {
        const [px, py] = [x + 0.5 - from.x, y + 0.5 - from.y];
        const along = length2 ? Math.max(0, Math.min(1, (px * dx + py * dy) / length2)) : 0;
        if (Math.hypot(px - along * dx, py - along * dy) <= radius) this.pixels[y * this.width + x] = masked ? SHOWN : 0;
      }
    }
  }

  /** Masks the area about a place whose colours differ from the one there by `tolerance` (of 255) at most. */
  fill({ data }: ImageData, at: Place, tolerance: number): void {
    const { width, height } = this;
    const start = Math.floor(at.y) * width + Math.floor(at.x);
    const alike = (pixel: number) => {
      for (let channel = 0; channel < 3; channel++) {
        if (Math.abs(data[4 * pixel + channel]! - data[4 * start + channel]!) > tolerance) return false;
      }
      return true;
    };
    const seen = new Uint8Array(width * height);
    const waiting = [start];
    const look = (pixel: number) => {
      if (seen[pixel] || !alike(pixel)) return;
      seen[pixel] = 1;
      waiting.push(pixel);
    };
    seen[start] = 1;
    for (let pixel = waiting.pop(); pixel !== undefined; pixel = waiting.pop()) {
      this.pixels[pixel] = SHOWN;
      const x = pixel % width;
      if (x > 0) look(pixel - 1);
      if (x < width - 1) look(pixel + 1);
      if (pixel >= width) look(pixel - width);
      if (pixel < width * (height - 1)) look(pixel + width);
    }
  }

  draw(canvas: HTMLCanvasElement): void {
    canvas.getContext("2d")!.putImageData(this.picture, 0, 0);
  }

  /** A file as the readers take it: masked pixels are black, or white where the mask is `inverted`. */
  async png(inverted: boolean): Promise<Blob> {
    const [masked, counting] = inverted ? [WHITE, BLACK] : [BLACK, WHITE];
    const picture = new ImageData(this.width, this.height);
    new Uint32Array(picture.data.buffer).set(this.pixels.map((pixel) => (pixel ? masked : counting)));
    const canvas = Object.assign(document.createElement("canvas"), { width: this.width, height: this.height });
    canvas.getContext("2d")!.putImageData(picture, 0, 0);
    return new Promise((done, failed) =>
      canvas.toBlob((blob) => (blob ? done(blob) : failed(new Error("The browser could not write the mask."))), "image/png"),
    );
  }
}
