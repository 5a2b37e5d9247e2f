// Photos in the frusta of their cameras: one mesh, cut from one picture.
import {
  BufferAttribute, BufferGeometry, DoubleSide, DynamicDrawUsage, Mesh, MeshBasicMaterial, SRGBColorSpace, type Texture,
  TextureLoader,
} from "three";
import type { SceneCamera, SheetCell } from "../result/widget_data";
import type { Frusta } from "./frusta";
import type { Look } from "./geometry";

/** The part of a picture where a camera's photo lies: left, top, right, bottom, each from 0 to 1. */
type Part = readonly [number, number, number, number];

class PhotoPlanes {
  readonly mesh: Mesh;
  private readonly positions: BufferAttribute;
  private readonly parts: BufferAttribute;
  private readonly material: MeshBasicMaterial;
  private url: string | null = null;

  constructor(
    private readonly count: number,
    opacity: number,
    private readonly onLoaded: () => void,
  ) {
    const geometry = new BufferGeometry();
    this.positions = new BufferAttribute(new Float32Array(12 * count), 3);
    this.positions.setUsage(DynamicDrawUsage);
    this.parts = new BufferAttribute(new Float32Array(8 * count), 2);
    geometry.setAttribute("position", this.positions);
    geometry.setAttribute("uv", this.parts);
    geometry.setIndex(Array.from({ length: count }, (_, i) => [0, 1, 2, 0, 2, 3].map((corner) => corner + 4 * i)).flat());
    this.material = new MeshBasicMaterial({ side: DoubleSide, transparent: true, opacity, depthWrite: false, visible: false });
    this.mesh = new Mesh(geometry, this.material);
    this.mesh.frustumCulled = false;
  }

  /** Shows this picture, once it has arrived; null shows none. */
  show(url: string | null): void {
    if (url === this.url) return;
    this.url = url;
    this.material.visible = false;
    this.material.map?.dispose();
    this.material.map = null;
    if (url) new TextureLoader().load(url, (texture) => this.paint(url, texture));
  }

  private paint(url: string, texture: Texture): void {
    if (url !== this.url) return texture.dispose(); // another one was asked for meanwhile
    texture.colorSpace = SRGBColorSpace;
    this.material.map = texture;
    this.material.needsUpdate = true;
    this.material.visible = true;
    this.onLoaded();
  }

  /** Draws it over everything else. */
  overAll(): void {
    this.material.depthTest = false;
    this.mesh.renderOrder = 3;
  }

  set opacity(value: number) {
    this.material.opacity = value;
  }

  /** Which part of the picture a camera shows; null shows nothing of it. */
  cut(index: number, part: Part | null): void {
    const [left, top, right, bottom] = part ?? [0, 0, 0, 0];
    const corners = [[left, top], [right, top], [right, bottom], [left, bottom]] as const;
    // three.js counts from the picture's lower edge.
    for (const [at, [x, y]] of corners.entries()) this.parts.setXY(4 * index + at, x, 1 - y);
    this.parts.needsUpdate = true;
  }

  /** Moves the photos into the frusta, as they are drawn. */
  follow(frusta: Frusta): void {
    for (let index = 0; index < this.count; index++) {
      for (let at = 0; at < 4; at++) this.positions.setXYZ(4 * index + at, ...frusta.drawn(index, at + 1));
    }
    this.positions.needsUpdate = true;
  }

  dispose(): void {
    this.mesh.geometry.dispose();
    this.material.map?.dispose();
    this.material.dispose();
  }
}

/** The part of the contact sheet that a camera's photo fills: the middle of its cell, in its own proportions. */
function partOf(cell: SheetCell, camera: SceneCamera): Part {
  const [left, top, right, bottom] = camera.borders;
  const aspect = (right - left) / (bottom - top);
  const width = Math.min(cell.width, cell.height * aspect);
  const height = Math.min(cell.height, cell.width / aspect);
  const x = cell.x + (cell.width - width) / 2;
  const y = cell.y + (cell.height - height) / 2;
  return [x / cell.sheet_width, y / cell.sheet_height, (x + width) / cell.sheet_width, (y + height) / cell.sheet_height];
}

/** The photos of all cameras in their frusta, or the one of the camera that one looks through over the view. */
export class Photos {
  private readonly all: PhotoPlanes;
  private readonly one: PhotoPlanes;
  private cellOf: Look["cellOf"] | null = null;

  constructor(
    private readonly cameras: readonly SceneCamera[],
    onLoaded: () => void,
  ) {
    this.all = new PhotoPlanes(cameras.length, 0.9, onLoaded);
    this.one = new PhotoPlanes(1, 0.5, onLoaded);
    this.one.overAll();
  }

  get meshes(): Mesh[] {
    return [this.all.mesh, this.one.mesh];
  }

  follow(frusta: Frusta): void {
    this.all.follow(frusta);
  }

  /** Shows what `look` asks for; `through` is the camera that one looks through, in the place of `chosen`. */
  show(look: Look, through: number | null, chosen: Frusta): void {
    if (this.cellOf !== look.cellOf) {
      this.cellOf = look.cellOf;
      this.cameras.forEach((camera, index) => {
        const cell = look.cellOf(index);
        this.all.cut(index, cell && partOf(cell, camera));
      });
    }
    this.all.show(look.photos ? (look.cellOf(0)?.url ?? null) : null);
    this.all.mesh.visible = through === null;
    const camera = through === null ? undefined : this.cameras[through];
    if (through === null || !camera) return this.one.show(null);
    const [photo, cell] = [look.photoOf(through), look.cellOf(through)];
    this.one.show(photo ?? cell?.url ?? null);
    this.one.opacity = look.overlay;
    this.one.cut(0, photo ? [0, 0, 1, 1] : cell && partOf(cell, camera));
    this.one.follow(chosen);
  }

  dispose(): void {
    this.all.dispose();
    this.one.dispose();
  }
}
