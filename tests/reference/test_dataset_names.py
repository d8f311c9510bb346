"""What a data set publishes of the folders that it was made from: names below them, and nothing of where they lie."""

import json
import shutil
import tarfile
from pathlib import Path

import trimesh
from inline_executor import Inline

from unirender_reference.dataset import generate
from unirender_reference.dataset_config import DatasetConfig
from unirender_reference.mesh_folder import MeshFile


def meshes(folder: Path) -> Path:
    """A box in a subfolder, an empty file and one that is no mesh."""
    (folder / "sub").mkdir(parents=True)
    trimesh.creation.box().export(folder / "sub" / "model.obj")
    (folder / "empty.obj").write_bytes(b"")
    (folder / "sub" / "broken.glb").write_bytes(b"not a mesh at all")
    return folder


def test_a_moved_folder_gives_the_same_bytes(tmp_path: Path) -> None:
    here = meshes(tmp_path / "a home folder" / "models")
    there = shutil.copytree(here, tmp_path / "models")
    outs = []
    for number, folder in enumerate((here, there)):
        outs.append(tmp_path / f"out{number}")
        config = DatasetConfig(None, 3, 8, "basis", outs[-1], spp=16, workers=1, meshes=folder)
        assert len(generate(config, executor=Inline()).failures) == 2
    for name in ("shard-000000.tar", "manifest.json", "failures.jsonl"):
        first, second = ((out / name).read_bytes() for out in outs)
        assert first == second
        assert str(tmp_path).encode() not in first
    with tarfile.open(outs[0] / "shard-000000.tar") as tar:
        stream = tar.extractfile(next(info for info in tar if info.name.endswith(".json")))
        assert stream is not None
        record = json.load(stream)
    assert record["file"] == "sub/model.obj"
    assert record["object_provenance"]["file"] == "sub/model.obj"
    files = [json.loads(line)["file"] for line in (outs[0] / "failures.jsonl").read_text().splitlines()]
    assert files == ["empty.obj", "sub/broken.glb"]


def test_messages_lose_the_folder(tmp_path: Path) -> None:
    (tmp_path / "true").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "true")
    file = MeshFile(tmp_path / "link" / "a" / "b.obj", "a/b.obj")
    assert file.without_folder(f"mesh {file.path}: bad") == "mesh a/b.obj: bad"
    assert file.without_folder(f"cannot open {tmp_path}/true/a/skin.png") == "cannot open a/skin.png"
    assert file.without_folder("a/b and /c") == "a/b and /c"
    assert MeshFile(Path("/a/b.obj"), "a/b.obj").without_folder("/a/b.obj: 1/2") == "/a/b.obj: 1/2"
