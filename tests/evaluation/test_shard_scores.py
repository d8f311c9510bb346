"""Scores on pictures of data sets: what is drawn, what is compared with what, what is printed."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from synthetic_shards import write_dataset

from unirender.cli import main
from unirender.composite import composite_image
from unirender.errors import UsageError
from unirender.intrinsics import Intrinsics
from unirender_evaluation.metrics import metric_key
from unirender_evaluation.shard_scores import COLUMNS, RENDERS, scored, shard_table
from unirender_evaluation.shard_scores_command import BenchShards

SIZE = 16


@dataclass
class Found:
    intrinsics: Intrinsics


class Halves:
    """Answers 0.5 for metallic and roughness, black for albedo, whatever it sees; remembers what it saw."""

    def __init__(self) -> None:
        self.seen: list[np.ndarray] = []

    def decompose(self, image_srgb: np.ndarray, mask: np.ndarray) -> Found:
        self.seen.append(image_srgb)
        half = np.full_like(mask, 0.5)
        return Found(Intrinsics(albedo=np.zeros_like(image_srgb), metallic=half, roughness=half, mask=mask))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("data"), shards=2, groups=3, size=SIZE)


def test_every_picture_is_held_against_its_own_truth(folder: Path) -> None:
    method = Halves()
    found = list(scored(method, folder, objects=100, pairs=100, seed=0))
    assert len({one.group for one in found}) == 6
    assert {one.metallic for one in found} == {0.0, 0.5, 1.0}
    for one in found:
        assert one.metallic is not None
        assert one.scores[metric_key("metallic", "mse_object")] == pytest.approx((one.metallic - 0.5) ** 2, abs=1e-6)
        assert metric_key("normal", "cosine") not in one.scores
    for image in method.seen:
        np.testing.assert_allclose(image * 255, np.round(image * 255), atol=1e-3)  # 8 bits, as methods see pictures


def test_a_draw_is_of_its_seed_and_no_larger_than_asked(folder: Path) -> None:
    def drawn(seed: int) -> list[tuple[str, float | None]]:
        return [(one.group, one.metallic) for one in scored(Halves(), folder, objects=2, pairs=2, seed=seed)]

    assert drawn(1) == drawn(1)
    assert len({tuple(drawn(seed)) for seed in range(5)}) > 1
    assert len(drawn(0)) == 4
    assert len({group for group, _ in drawn(0)}) == 2


def test_the_table_has_a_row_for_each_folder_and_metallic(folder: Path) -> None:
    found = list(scored(Halves(), folder, objects=6, pairs=100, seed=0))
    table = shard_table(found, "Halves.")
    (rows,) = table.sections
    assert [row[0] for row in rows] == [f"{folder}: all", "metallic 0", "metallic 0.5", "metallic 1"]
    metallic = 3 + list(COLUMNS).index("metallic MSE ↓")
    assert [row[metallic].split(" ")[0] for row in rows[1:]] == ["0.2500", "0.0000", "0.2500"]
    assert {row[3 + list(COLUMNS).index("normal cos ↑")] for row in rows} == {"-"}
    assert int(rows[0][2]) == sum(int(row[2]) for row in rows[1:])


class Painter(Halves):
    """Renders the composite of what it is given, or black where s and d are left to it; remembers which."""

    def __init__(self) -> None:
        super().__init__()
        self.given: list[bool] = []

    def render(self, intrinsics: Intrinsics) -> np.ndarray:
        self.given.append(intrinsics.specular is not None)
        assert (intrinsics.specular is None) == (intrinsics.diffuse is None)
        assert intrinsics.environment is not None
        return composite_image(intrinsics) if self.given[-1] else np.zeros_like(intrinsics.require("albedo")["albedo"])


def test_renders_are_scored_where_they_are_asked_for(folder: Path) -> None:
    method = Painter()
    found = list(scored(method, folder, objects=1, pairs=2, seed=0, renders=True))
    assert method.given == [True, False, True, False]
    for one in found:
        given, light, closed = (one.scores[key] for key, _ in RENDERS.values())
        assert np.isfinite(closed)
        assert given > light
    header = shard_table(found, "Painter.").columns
    assert tuple(RENDERS) == header[-len(RENDERS) :]
    assert not set(RENDERS) & set(shard_table(list(scored(method, folder, 1, 1, 0)), "Painter.").columns)


def test_the_command_scores_the_shipped_model(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert BenchShards(data=(folder,), objects=1, pairs=1, renders=True, out=tmp_path / "t.md").run() == 0
    text = (tmp_path / "t.md").read_text()
    assert set(RENDERS) <= set(map(str.strip, text.split("|")))
    assert "albedo" in capsys.readouterr().out
    assert text.startswith("### Pictures of data sets")
    assert " nan" not in text


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"data": ()}, "at least one folder"),
        ({"data": (Path("a"), Path("a"))}, "none of them twice"),
        ({"data": (Path("a"),), "objects": 0}, "objects"),
    ],
)
def test_what_cannot_be_asked_is_refused(options: dict, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        BenchShards(**options).check()


def test_a_folder_without_shards_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="1"):
        main(["bench", "shards", "--data", str(tmp_path / "absent")])
    assert "absent" in capsys.readouterr().err
