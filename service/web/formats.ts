// Written by `make docs` from the declarations of formats in biresnerf/data/formats.
export const READ_FORMATS = "transforms.json (nerfstudio, instant-ngp, Blender), COLMAP, transforms_ngp.json (instant-ngp), LLFF, Bundler, Metashape, 3DGS cameras.json, TUM, KITTI";

export const RESULT_FORMATS = [
  {
    "name": "For nerfstudio",
    "words": "Replaces the transforms.json of the photos; then: ns-train nerfacto --data FOLDER",
    "files": "transforms.json"
  },
  {
    "name": "For 3D Gaussian splatting, gsplat, OpenMVS",
    "words": "Photos without distortion, with PINHOLE cameras and points",
    "files": "pinhole/",
    "exported": "pinhole"
  },
  {
    "name": "For COLMAP",
    "words": "A binary model with the input's ids; gsplat and 3DGS read it too if the lenses have no distortion",
    "files": "colmap/sparse/"
  },
  {
    "name": "For COLMAP, as text",
    "words": "For programs that read no binary models",
    "files": "colmap/sparse_txt/",
    "exported": "colmap-text"
  },
  {
    "name": "For instant-ngp",
    "words": "Put it into the folder of the photos and open it in instant-ngp",
    "files": "transforms_ngp.json",
    "exported": "instant-ngp"
  },
  {
    "name": "For Blender",
    "words": "Cameras before and after, and points: File › Import › glTF",
    "files": "scene.glb"
  },
  {
    "name": "For LLFF",
    "words": "In the format of the input",
    "files": "poses_bounds.npy"
  },
  {
    "name": "For Metashape",
    "words": "Bundler format: File › Import › Import Cameras",
    "files": "bundler/",
    "exported": "bundler"
  },
  {
    "name": "For evo and SLAM tools",
    "words": "A trajectory in TUM format",
    "files": "tum.txt"
  },
  {
    "name": "For odometry tools",
    "words": "A trajectory in KITTI format",
    "files": "kitti.txt",
    "exported": "kitti"
  },
  {
    "name": "For your own programs",
    "words": "Each pose before and after, in full precision",
    "files": "poses.json"
  }
];
