"""Writes a suite's inputs for foreign code, in the folder names that `predictions` reads answers from.

    <picture>/image.png                  what a method may see: 8-bit sRGB, straight, with the mask as alpha
    <picture>/mask.exr                   the same mask (mask.Y) unrounded, as a plug-in is handed it, in float32
    <picture>/meta.json                  the suite, the camera, and the questions by the name of their answer: table,
                                         protocol, what is asked, new metallic or roughness
    <picture>/<answer>/given.exr         maps given with a question (true ones, or s and d of another light): channels
                                         of the data contract, linear, half floats
    <picture>/<answer>/environment.exr   the light given with it: R, G, B, linear, float32, lat-long in camera axes

A picture that no method may see (its true maps are given instead) has no `image.png` and no `mask.exr`. No truth is
written but what its protocol gives away: folders have neutral names and are written in the order of these, so that
neither names nor times say which object or material a picture is of.
"""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from unirender.exr import CAMERA_ATTRIBUTE, intrinsics_channels, write_environment, write_exr
from unirender.intrinsics import Intrinsics
from unirender_evaluation.suites.suite import Suite
from unirender_evaluation.task import PROTOCOLS, Task
from unirender_evaluation.tasks import scene_ids, tasks


def export_inputs(suite: Suite, out: Path, limit: int | None = None) -> Counter[str]:
    """Writes the inputs of all protocols (see the module); returns how many questions there are of each kind of answer:
    intrinsics, environment, edit, relight, render."""
    asked: dict[str, list[Task]] = {}
    for table, protocol in PROTOCOLS:
        for task in tasks(suite, table, protocol, scene_ids(suite, limit)):
            asked.setdefault(task.folder, []).append(task)
    kinds = Counter(task.answer.partition("_")[0] for own in asked.values() for task in own)
    for name in sorted(asked):
        folder = out / name
        folder.mkdir(parents=True)
        meta = {
            "suite": suite.spec.name,
            "suite_sha256": suite.sha256,
            "fov_deg": suite.spec.fov_deg,
            "answers": {task.answer: _write_question(task, folder) for task in asked.pop(name)},
        }
        (folder / "meta.json").write_text(json.dumps(meta, indent=1) + "\n", encoding="utf-8")
    return kinds


def _write_question(task: Task, folder: Path) -> dict[str, Any]:
    """Writes what comes with a question and describes it."""
    question: dict[str, Any] = {"table": task.table, "protocol": task.protocol, "asks": list(task.asks)}
    for capability in task.asks:
        inputs = task.inputs[capability]
        if "image_srgb" in inputs:
            _write_picture(folder / "image.png", inputs["image_srgb"], inputs["mask"])
            write_exr(folder / "mask.exr", {"mask.Y": inputs["mask"][..., 0]}, half=False)
        question |= {name: inputs[name] for name in ("metallic", "roughness") if name in inputs}
        given = inputs.get("intrinsics") or Intrinsics(
            **{name: inputs[name] for name in ("specular", "diffuse", "environment") if inputs.get(name) is not None}
        )
        channels = intrinsics_channels(given)
        if channels:
            (folder / task.answer).mkdir(exist_ok=True)
            camera = inputs.get("camera") or given.camera
            attributes = {CAMERA_ATTRIBUTE: camera.describe()}
            write_exr(folder / task.answer / "given.exr", channels, attributes=attributes)
        if given.environment is not None:
            (folder / task.answer).mkdir(exist_ok=True)
            write_environment(folder / task.answer / "environment.exr", given.environment)
    return question


def _write_picture(path: Path, image_srgb: np.ndarray, mask: np.ndarray) -> None:
    from PIL import Image

    levels = np.round(np.concatenate([image_srgb, mask], axis=-1) * 255).astype(np.uint8)
    Image.fromarray(levels).save(path)
