"""Tiny public test sets in the layouts of their authors, with a truth that the tests know."""

import json
from pathlib import Path

import numpy as np
from PIL import Image

from unirender.color import image_srgb
from unirender.exr import image_channels, write_exr

SIDE = 64  # of Stanford-ORB's photographs here; runs compare them at half of it
RADIUS = 0.7  # of the object, as a part of half the frame
ALBEDO = np.array([0.6, 0.4, 0.2], np.float32)
LIGHT = {"cup_scene001": np.array([1.0, 1.0, 1.0], np.float32), "cup_scene002": np.array([0.5, 0.8, 1.2], np.float32)}
POSE = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]], float)  # in front, looks along -z


def sphere(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Normals (camera axes, seen from afar) and mask of a sphere in the frame's middle."""
    y, x = (1 - (2 * np.mgrid[:side, :side] + 1) / side) * np.array([[[1]], [[-1]]])
    x, y = x / RADIUS, y / RADIUS
    inside = x**2 + y**2 < 1
    normal = np.stack([x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1) * inside[..., None]
    return normal.astype(np.float32), inside[..., None].astype(np.float32)


def turned(degrees: float) -> np.ndarray:
    """The pose after a turn about the world's +y."""
    a = np.radians(degrees)
    turn = np.array([[np.cos(a), 0, np.sin(a), 0], [0, 1, 0, 0], [-np.sin(a), 0, np.cos(a), 0], [0, 0, 0, 1]])
    return turn @ POSE


def make_orb(folder: Path) -> Path:
    """Two captures of a sphere of one albedo, brightest in its middle, each under an even light of its own colour.

    Both have one test photograph from the front. For the first, the other's is novel from the same camera, and once
    more (a second test photograph of the other) from 40 degrees to the side.
    """
    normal, mask = sphere(SIDE)
    for capture, light in LIGHT.items():
        radiance = ALBEDO * light * mask * (0.4 + 0.6 * normal[..., 2:])
        ids = ["0000"] if capture == "cup_scene001" else ["0000", "0001"]
        poses = [POSE, turned(40)]
        for name in ids:
            _png(folder / "blender_LDR" / capture / "test" / f"{name}.png", image_srgb(radiance))
            _png(folder / "blender_LDR" / capture / "test_mask" / f"{name}.png", mask[..., 0])
            _exr(folder / "blender_HDR" / capture / "test" / f"{name}.exr", radiance)
            truth = folder / "ground_truth" / capture
            _npy(truth / "surface_normal" / f"{name}.npy", normal)
            _npy(truth / "z_depth" / f"{name}.npy", (3 - normal[..., 2]) * mask[..., 0])
            _png(truth / "pseudo_gt_albedo" / f"{name}.png", image_srgb(ALBEDO * mask))
            _exr(truth / "env_map" / f"{name}.exr", np.broadcast_to(light, (16, 32, 3)))
        frames = [{"file_path": f"test/{n}", "transform_matrix": p.tolist()} for n, p in zip(ids, poses, strict=False)]
        _json(folder / "blender_LDR" / capture / "transforms_test.json", {"camera_angle_x": 0.6, "frames": frames})
    novel = [
        {
            "scene_name": "cup_scene002",
            "camera_angle_x": 0.6,
            "file_path": f"./test/{n}",
            "transform_matrix": p.tolist(),
        }
        for n, p in (("0000", POSE), ("0001", turned(40)))
    ]
    _json(folder / "blender_LDR" / "cup_scene001" / "transforms_novel.json", {"frames": novel})
    return folder


def make_iiw(folder: Path) -> Path:
    """Two photographs, dark left and bright right halves; people call the left point darker, with weight 2, and two
    points of the right half equal, with weight 1. A third has no judgement that counts."""
    for name in ("100", "101", "102"):
        photo = np.full((20, 30, 3), 0.2, np.float32)
        photo[:, 15:] = 0.6
        _png(folder / "data" / f"{name}.png", image_srgb(photo))
        points = [
            {"id": 1, "x": 0.25, "y": 0.5, "opaque": True},
            {"id": 2, "x": 0.75, "y": 0.5, "opaque": True},
            {"id": 3, "x": 0.9, "y": 0.2, "opaque": True},
            {"id": 4, "x": 0.1, "y": 0.2, "opaque": False},
        ]
        pairs = [
            {"point1": 1, "point2": 2, "darker": "1", "darker_score": 2.0},
            {"point1": 2, "point2": 3, "darker": "E", "darker_score": 1.0},
            {"point1": 4, "point2": 2, "darker": "2", "darker_score": 9.0},  # a point on glass: does not count
            {"point1": 1, "point2": 3, "darker": "2", "darker_score": 0.0},  # nor this
            {"point1": 1, "point2": 3, "darker": None, "darker_score": None},
        ]
        _json(
            folder / "data" / f"{name}.json",
            {"intrinsic_points": points, "intrinsic_comparisons": pairs[2 * (name == "102") :]},
        )
    return folder


def make_maw(folder: Path) -> Path:
    """A photograph with two measured surfaces: grey 0.2 in its left third, 0.6 in its right third."""
    photo = np.full((240, 320, 3), 0.9, np.float32)
    mask = np.zeros((240, 320), np.uint8)
    for label, (columns, grey) in {3: (slice(0, 100), 0.2), 7: (slice(220, 320), 0.6)}.items():
        photo[:, columns], mask[:, columns] = grey, label
    _png(folder / "images_png" / "scene_0" / "DSC1.png", image_srgb(photo))
    labels = folder / "labels"
    _npy(labels / "colors" / "DSC1.npy", np.array([[0.2] * 3, [0.6] * 3]))
    Image.fromarray(mask).save(labels / "colors" / "DSC1_mask.png")
    row = ["colors/DSC1.npy", "colors/DSC1_mask.png", "scene_0", "DSC1", "colors/DSC1_albedo.png", "None"]
    (labels / "meta.csv").write_text("\t".join(row) + "\n")
    return folder


def _png(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.round(values * 255).astype(np.uint8)).save(path)


def _exr(path: Path, radiance: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_exr(path, image_channels(np.asarray(radiance, np.float32)), half=False)


def _npy(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, values)


def _json(path: Path, content: dict) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
