"""`unirender meshes` on a folder of good and broken files: one reason for each broken one, exit status 1."""

import json
import os
import re
from pathlib import Path

from broken_files import BROKEN
from gltf_files import GOOD, GltfWriter, write_metallic_roughness

from unirender_reference.measure.meshes import Meshes, MeshSummary, read_meshes


def test_folder_of_five_good_and_ten_broken(tmp_path, capsys):
    folder = tmp_path / "models"
    folder.mkdir()
    good = [write(folder).path.name for write in GOOD]
    broken = [write(folder).name for write in BROKEN]
    assert Meshes(str(folder)).run() == 1
    out = capsys.readouterr().out
    refused = [line for line in out.splitlines() if line.startswith("refused  ")]
    assert len(refused) == 10
    assert all(sum(name in line for line in refused) == 1 for name in broken)
    assert not any(name in line for line in refused for name in good)
    assert Meshes(str(folder), json=True).run() == 1
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(rows) == 15
    assert {row["path"].split("/")[-1] for row in rows if "reason" not in row} == set(good)


def test_good_files_alone_succeed(tmp_path, capsys):
    for write in GOOD:
        write(tmp_path)
    assert Meshes(str(tmp_path / "*.gl*")).run() == 0
    assert "refused" in capsys.readouterr().out
    summary = MeshSummary()
    for row in read_meshes(str(tmp_path), limit=3):
        summary.add(row)
    assert len(summary.faces) == 3
    assert summary.refused == 0


def test_constants_and_maps_are_told_apart(tmp_path, capsys):
    """The quad without a material is rough and metallic all over; the file beside it has pictures of both."""
    writer = GltfWriter()
    writer.mesh(writer.quad(None))
    writer.glb(tmp_path / "plain.glb")
    write_metallic_roughness(tmp_path)
    first, second = read_meshes(str(tmp_path))
    assert (first["maps"], first["constants"]) == (["roughness", "metallic"], [])
    assert (second["maps"], second["constants"]) == ([], ["roughness", "metallic"])
    assert Meshes(str(tmp_path)).run() == 0
    out = capsys.readouterr().out
    assert re.search(r"roughness of its own: constant +│ 1 ", out)
    assert re.search(r"roughness of its own: a map +│ 1 ", out)


def test_a_folder_that_cannot_be_listed_is_reported(tmp_path, capsys, monkeypatch):
    (tmp_path / "locked").mkdir()
    write_metallic_roughness(tmp_path)
    scandir = os.scandir

    def refusing(path):
        if Path(path).name == "locked":
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", refusing)
    assert Meshes(str(tmp_path)).run() == 1
    out = capsys.readouterr().out
    assert f"folder {tmp_path}/locked: cannot be listed (Permission denied)" in out
    assert re.search(r"refused +│ 0 ", out)
    assert re.search(r"folders that cannot be listed +│ 1 ", out)
