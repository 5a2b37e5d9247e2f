// Who the files of a result are for.
import type { ArtifactView } from "schemas";

export interface Consumer {
  name: string;
  words: string;
  /** A file, or a folder (with a slash at its end). */
  files: string;
  /** The form that has to be asked for, where it is not always written. */
  pack?: string;
}

export const CONSUMERS: readonly Consumer[] = [
  {
    name: "For nerfstudio",
    words: "Put it in the place of the photos' transforms.json, then: ns-train nerfacto --data FOLDER",
    files: "transforms.json",
  },
  {
    name: "For 3D Gaussian splatting, gsplat, OpenMVS",
    words: "Photos without distortion, with PINHOLE cameras and points",
    files: "pinhole/",
    pack: "pinhole",
  },
  {
    name: "For COLMAP",
    words: "A binary model with the input's ids; gsplat and 3DGS read it too where lenses have no distortion",
    files: "colmap/sparse/",
  },
  { name: "For COLMAP, as text", words: "For what reads no binary models", files: "colmap/sparse_txt/", pack: "colmap-text" },
  {
    name: "For instant-ngp",
    words: "Put it into the photos' folder, then open it in instant-ngp",
    files: "transforms_ngp.json",
    pack: "instant-ngp",
  },
  { name: "For Blender", words: "Cameras before and after, and points: File › Import › glTF", files: "scene.glb" },
  {
    name: "For Metashape",
    words: "Bundler's form: File › Import › Import Cameras",
    files: "bundler/",
    pack: "bundler",
  },
  { name: "For evo and SLAM tools", words: "A trajectory in TUM's form", files: "tum.txt" },
  { name: "For odometry tools", words: "A trajectory in KITTI's form", files: "kitti.txt", pack: "kitti" },
  { name: "For LLFF", words: "In the form of the input", files: "poses_bounds.npy" },
  { name: "For your own programs", words: "Each pose before and after, with all digits", files: "poses.json" },
  { name: "To show to others", words: "This page as one file that needs no network", files: "report.html" },
  { name: "To show to others, moving", words: "A flight around the scene", files: "renders/orbit.mp4" },
  { name: "Figures and evidence", words: "The verdict's numbers, and what became of each image", files: "report.json" },
  {
    name: "The refined poses, which the verdict did not take",
    words: "In the same forms as the result",
    files: "refined/",
  },
];

export function filesFor(consumer: Consumer, artifacts: readonly ArtifactView[]): ArtifactView[] {
  const { files } = consumer;
  return artifacts.filter(({ name }) => (files.endsWith("/") ? name.startsWith(files) : name === files));
}

/** Shell and Python lines that bring the same files. */
export function curlLines(jobUrl: string, consumer: Consumer, found: readonly ArtifactView[], keyed: boolean): string {
  const key = keyed ? ' -H "Authorization: Bearer $BIRESNERF_API_KEY"' : "";
  const lone = found.length === 1 ? found[0] : undefined;
  if (lone) return `curl -fL${key} -O ${new URL(lone.href, jobUrl).href}`;
  const origin = new URL(jobUrl).origin;
  return [
    `curl -f${key} ${jobUrl}/artifacts |`,
    `  jq -r '.items[] | select(.name | startswith("${consumer.files}")) | [.name, .href] | @tsv' |`,
    `  while IFS=$'\\t' read -r name href; do curl -fL${key} --create-dirs -o "$name" "${origin}$href"; done`,
  ].join("\n");
}

export function pythonLines(jobUrl: string, id: string, consumer: Consumer, keyed: boolean): string {
  const url = new URL(jobUrl).origin;
  const wanted = consumer.files.endsWith("/") ? `${consumer.files}*` : consumer.files;
  return [
    ...(keyed ? ["import os"] : []),
    "from pathlib import Path",
    "from biresnerf.client import Client",
    "",
    `with Client("${url}"${keyed ? ', api_key=os.environ["BIRESNERF_API_KEY"]' : ""}) as client:`,
    `    client.download_all("${id}", Path("result"), names=["${wanted}"])`,
  ].join("\n");
}
