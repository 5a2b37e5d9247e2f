"""Readers of other programs, run unmodified: `python readers.py PROGRAM FILE`. Prints what was read, as JSON.

Runs in the environment of `make consumers-check`, which has none of this project's code. Poses are world_from_cam with
OpenCV axes, by the name that the program gives to the image.
"""

from __future__ import annotations

import json
import os
import sys
import types
from pathlib import Path

import numpy as np

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def sources(program: str) -> str:
    """A program's checkout in $BIRESNERF_CONSUMER_SOURCES, from which modules are imported now."""
    place = f"{os.environ['BIRESNERF_CONSUMER_SOURCES']}/{program}"
    sys.path.insert(0, place)
    return place


def square(matrix) -> np.ndarray:
    whole = np.eye(4)
    whole[: len(matrix)] = matrix
    return whole


def nerfstudio(file: Path) -> dict:
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    return parsed(NerfstudioDataParserConfig(data=file), file.parent)


def nerfstudio_colmap(folder: Path) -> dict:
    with_rawpy()
    from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig

    return parsed(ColmapDataParserConfig(data=folder, colmap_path=Path("sparse/0")), folder / "images")


def with_rawpy() -> None:
    """nerfstudio names a fork of rawpy whose wheels fit older NumPys only; nothing here reads RAW."""
    import rawpy

    sys.modules["newrawpy"] = rawpy


def parsed(config, root: Path) -> dict:
    """What a data parser of nerfstudio gives for all images, its own changes of the world left out."""
    config.orientation_method = config.center_method = "none"
    config.auto_scale_poses = False
    config.eval_mode = "all"
    config.downscale_factor = 1
    config.load_3D_points = True  # as splatfacto asks for
    found = config.setup().get_dataparser_outputs("train")
    back = np.linalg.inv(square(found.dataparser_transform.double().numpy()))
    cameras = found.cameras
    poses, lenses = {}, {}
    for i, path in enumerate(found.image_filenames):
        assert Path(path).is_file(), path
        name = Path(path).relative_to(root).as_posix()
        pose = square(cameras.camera_to_worlds[i].double().numpy())
        poses[name] = (back @ pose @ OPENCV_FROM_OPENGL).tolist()
        given = cameras.distortion_params
        lenses[name] = {
            "type": int(cameras.camera_type[i]),
            "size": [int(cameras.width[i]), int(cameras.height[i])],
            "pinhole": [float(getattr(cameras, key)[i]) for key in ("fx", "fy", "cx", "cy")],
            "k1 k2 k3 k4 p1 p2": [0.0] * 6 if given is None else given[i].tolist(),
        }
    points = found.metadata.get("points3D_xyz")
    moved = [] if points is None else (points.double().numpy() @ back[:3, :3].T + back[:3, 3]).tolist()
    return {"poses": poses, "lenses": lenses, "points": moved}


def nerfstudio_realitycapture(folder: Path) -> dict:
    """nerfstudio's converter of RealityCapture's csv."""
    with_rawpy()
    from nerfstudio.process_data.realitycapture_utils import realitycapture_to_json

    photos = {path.stem: path.relative_to(folder) for path in (folder / "images").iterdir()}
    realitycapture_to_json(photos, folder / "realitycapture.csv", None, folder)
    document = json.loads((folder / "transforms.json").read_text())
    frames = {frame["file_path"]: frame for frame in document["frames"]}
    return {
        "poses": {
            name: (np.array(frame["transform_matrix"]) @ OPENCV_FROM_OPENGL).tolist()
            for name, frame in frames.items()
        },
        "lenses": {
            name: {key: value for key, value in frame.items() if isinstance(value, int | float)}
            for name, frame in frames.items()
        },
    }


def pycolmap(folder: Path) -> dict:
    import pycolmap

    model = pycolmap.Reconstruction(folder)
    poses = {
        image.name: square(image.cam_from_world().inverse().matrix()).tolist()
        for image in model.images.values()
    }
    return {"poses": poses, "points": [point.xyz.tolist() for point in model.points3D.values()]}


def evo_tum(file: Path) -> dict:
    from evo.tools.file_interface import read_tum_trajectory_file

    trajectory = read_tum_trajectory_file(file)
    return {"rows": [pose.tolist() for pose in trajectory.poses_se3], "times": trajectory.timestamps.tolist()}


def evo_kitti(file: Path) -> dict:
    from evo.tools.file_interface import read_kitti_poses_file

    return {"rows": [pose.tolist() for pose in read_kitti_poses_file(file).poses_se3]}


def open3d_mesh(file: Path) -> dict:
    import open3d

    mesh = open3d.io.read_triangle_mesh(str(file))
    return {"vertices": np.asarray(mesh.vertices).tolist(), "triangles": len(mesh.triangles)}


def open3d_points(file: Path) -> dict:
    import open3d

    cloud = open3d.io.read_point_cloud(str(file))
    return {"points": np.asarray(cloud.points).tolist(), "colours": np.asarray(cloud.colors).tolist()}


def trimesh_scene(file: Path) -> dict:
    import trimesh

    scene = trimesh.load_scene(file)
    kinds = [type(one).__name__ for one in scene.geometry.values()]
    return {"kinds": sorted(kinds), "bounds": scene.bounds.tolist()}


def trimesh_points(file: Path) -> dict:
    import trimesh

    cloud = trimesh.load(file)
    return {"points": cloud.vertices.tolist(), "colours": (cloud.colors[:, :3] / 255.0).tolist()}


def blender(file: Path) -> dict:
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=str(file))
    return {
        thing.name: {
            "vertices": [list(thing.matrix_world @ vertex.co) for vertex in thing.data.vertices],
            "edges": len(thing.data.edges),
            "faces": len(thing.data.polygons),
        }
        for thing in bpy.data.objects
        if thing.type == "MESH"
    }


def splatting(folder: Path) -> dict:
    """3D Gaussian Splatting's dataset reader, from its source; what it compiles for CUDA has an empty stand-in."""
    source = sources("gaussian-splatting")
    knn, scene_room = types.ModuleType("simple_knn._C"), types.ModuleType("scene")
    knn.distCUDA2 = None
    scene_room.__path__ = [f"{source}/scene"]  # its __init__ imports the trainer
    sys.modules |= {"simple_knn": types.ModuleType("simple_knn"), "simple_knn._C": knn, "scene": scene_room}
    from scene.dataset_readers import readColmapSceneInfo

    parameters = readColmapSceneInfo.__code__.co_varnames[: readColmapSceneInfo.__code__.co_argcount]
    more = {"depths": "", "train_test_exp": False}
    scene = readColmapSceneInfo(
        str(folder), "images", eval=False, **{key: value for key, value in more.items() if key in parameters}
    )
    poses = {}
    for camera in scene.train_cameras:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = camera.R, -camera.R @ camera.T  # R is stored transposed
        poses[camera.image_name] = pose.tolist()
    return {"poses": poses, "points": np.asarray(scene.point_cloud.points).tolist()}


def gsplat(folder: Path) -> dict:
    """The parser of gsplat's examples, from its source."""
    sources("gsplat/examples")
    from datasets.colmap import Parser

    parser = Parser(str(folder), factor=1, normalize=False, test_every=8)
    Parser(str(folder), factor=1, normalize=True, test_every=8)  # what its trainer does
    poses = dict(zip(parser.image_names, parser.camtoworlds.tolist(), strict=True))
    return {"poses": poses, "points": parser.points.tolist()}


def llff(folder: Path) -> dict:
    """nerf-pytorch's loader of LLFF sets, from its source."""
    sources("nerf-pytorch")
    from load_llff import _load_data

    os.chdir(folder)
    poses, bounds, images = _load_data(str(folder), factor=None)
    return {
        "rows": np.moveaxis(poses, -1, 0).tolist(),
        "bounds": bounds.T.tolist(),
        "pixels": np.moveaxis(images, -1, 0)[:, 0, 0].tolist(),
    }


if __name__ == "__main__":
    found = globals()[sys.argv[1]](Path(sys.argv[2]))
    sys.stdout.write("\n" + json.dumps(found) + "\n")
