"""Scores of whole predictions: compositing, pasted and own masks, absent maps, refusals."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from unirender.color import image_srgb, srgb_decode, srgb_encode, unpremultiply
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender_evaluation import metrics
from unirender_evaluation.lpips import load
from unirender_evaluation.methods.mistakes import GAINS, MISTAKES, MOST_DB
from unirender_evaluation.methods.plausible import picture_doubt, range_doubt
from unirender_evaluation.methods.suspicions import suspicions
from unirender_evaluation.metrics import OWN_MASK, SCALES, metric_key
from unirender_evaluation.records import Record
from unirender_evaluation.scoring import MATERIALS, score_colour, score_image, score_maps
from unirender_evaluation.ssim import ssim
from unirender_evaluation.suites.suite import Scene
from unirender_evaluation.tables.mistakes import mistakes_said, truth_said
from unirender_evaluation.task import Asked, Task

SIZE = 32


def disc(radius: float = 11) -> np.ndarray:
    y, x = np.mgrid[0:SIZE, 0:SIZE] - (SIZE - 1) / 2
    return np.clip(radius - np.hypot(y, x), 0, 1).astype(np.float32)[..., None]


def intrinsics(seed: int) -> Intrinsics:
    rng = np.random.default_rng(seed)
    mask = disc()
    inside = mask > 0
    normal = rng.normal(size=(SIZE, SIZE, 3)) + np.array([0, 0, 2])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return Intrinsics(
        albedo=rng.random((SIZE, SIZE, 3)) * inside,
        normal=normal * inside,
        roughness=rng.random((SIZE, SIZE, 1)) * inside,
        metallic=rng.random((SIZE, SIZE, 1)) * inside,
        specular=3 * rng.random((SIZE, SIZE, 3)) * inside,
        diffuse=rng.random((SIZE, SIZE, 3)) * inside,
        environment=rng.random((16, 32, 3)),
        mask=mask,
    )


def test_the_truth_scores_perfectly() -> None:
    truth = intrinsics(0)
    for key, value in score_maps(truth, truth).items():
        metric = metrics.METRICS[key.partition(".")[2].partition("@")[0]]
        if metric.name in ("psnr", "angle_deg", "log_rmse", "ciede2000", "ssim", "cosine"):
            tolerant = metric.name == "psnr" and "aligned" in key  # a factor of 1 up to rounding
            assert value > 100 if tolerant else value == pytest.approx(metric.perfect, abs=1e-4), key
        else:
            assert value == metric.perfect, key


def around(width: int) -> np.ndarray:
    """A frame whose border of so many pixels is covered: around a hole, rings shrink."""
    mask = np.ones((20, 20, 1), np.float32)
    mask[width:-width, width:-width] = 0
    return mask


def test_a_picture_of_any_exposure_is_no_doubt_and_one_of_other_units_is() -> None:
    mask, rng = disc(), np.random.default_rng(0)
    noise = rng.random((SIZE, SIZE, 3)) * mask
    assert picture_doubt(noise, mask) is None
    assert "is 25, expected linear radiance with white at 1" in (picture_doubt(mask * 25 * np.ones(3), mask) or "")
    assert picture_doubt(mask * 15 * np.ones(3), mask) is None
    whole = np.ones_like(mask)
    assert picture_doubt(whole * 1e4 * np.ones(3), whole) is None, "a photograph, of any exposure"
    assert range_doubt(mask * 200 * np.ones(3), mask, 255.0) is None
    assert "below -0.3" in (range_doubt(np.where(rng.random(noise.shape) < 0.15, -0.3, noise), mask) or "")
    assert range_doubt(np.where(rng.random(noise.shape) < 0.05, -0.3, noise), mask) is None, "ringing"
    assert range_doubt(noise, 0 * mask) is None


def test_the_background_is_what_no_filter_of_the_object_reaches() -> None:
    """Two pixels away from all that is covered, however little; what is negative there is no black."""
    mask = around(6)  # rings of 28, 20, 12 and 4 pixels are not covered
    picture = mask * np.ones(3)
    for level, doubted in ((0.01, False), (0.03, True), (-0.03, True)):
        found = picture_doubt(np.where(mask > 0, picture, level), mask)
        assert (found is not None) == doubted, level
        assert not doubted or f"radiance {abs(level)} (median) where no object is" in (found or "")
    assert picture_doubt(np.maximum(picture, around(8)), mask) is None, "two pixels around the object"
    assert picture_doubt(np.maximum(picture, around(9)), np.maximum(mask, 0.3 * around(7))) is None
    assert picture_doubt(np.ones((20, 20, 3)), np.maximum(around(9), mask)) is None, "nothing is further away"


def asked(truth: Intrinsics, picture: np.ndarray | None = None) -> Task:
    mask = truth.require("mask")["mask"]
    known = Asked(mask, {}, truth_image=picture, truth_maps=truth)
    scene = Scene("ball-0_l0", "ball-0", "ball", False, "sky", 0, 1.0, ())
    return Task("inverse", "single-image", "s", scene, ("decompose",), "s", "intrinsics", lambda: known)


def changed(name: str, undo: Callable[[np.ndarray], np.ndarray]) -> Callable[[Intrinsics], Intrinsics]:
    return lambda maps: maps.replace(**{name: np.ascontiguousarray(undo(maps.require(name)[name]))})


def exchanged(maps: Intrinsics) -> Intrinsics:
    return maps.replace(roughness=maps.metallic, metallic=maps.roughness)


def premultiplied(maps: Intrinsics) -> Intrinsics:
    found = maps.require("albedo", "mask")
    return maps.replace(albedo=found["albedo"] * found["mask"])


def cropped(maps: Intrinsics) -> Intrinsics:
    """The box around the object stretched to the frame, by the nearest pixel."""
    rows = np.flatnonzero(np.any(maps.require("mask")["mask"] > 0, axis=(1, 2)))
    seen = rows[0] + ((np.arange(SIZE) + 0.5) * len(rows) / SIZE).astype(int)
    return maps.replace(albedo=maps.require("albedo")["albedo"][seen][:, seen])


MADE: dict[
    str, tuple[str, Callable[[Intrinsics], Intrinsics]]
] = {  # mistake -> the quantity that tells, how it is made
    "if_decoded": ("albedo", changed("albedo", srgb_encode)),
    "if_encoded": ("albedo", changed("albedo", srgb_decode)),
    "if_bgr": ("specular", changed("specular", lambda x: x[..., ::-1])),
    "if_edges": ("albedo", premultiplied),
    "if_mirrored": ("normal", changed("normal", lambda x: x[:, ::-1] * np.array([-1, 1, 1], np.float32))),
    "if_upside_down": ("diffuse", changed("diffuse", lambda x: x[::-1])),
    "if_shifted": ("albedo", changed("albedo", lambda x: np.roll(x, 1, 0))),
    "if_in_box": ("albedo", cropped),
    "if_y_down": ("normal", changed("normal", lambda x: x * np.array([1, -1, 1], np.float32))),
    "if_opencv": ("normal", changed("normal", lambda x: x * np.array([1, -1, -1], np.float32))),
    "if_x_left": ("normal", changed("normal", lambda x: x * np.array([-1, 1, 1], np.float32))),
    "if_other_signs": ("normal", changed("normal", lambda x: -x)),
    "if_other_axes": ("normal", changed("normal", lambda x: x[..., [0, 2, 1]] * np.array([1, -1, 1], np.float32))),
    "if_turned": ("environment", changed("environment", lambda x: np.roll(x, 16, 1))),
    "if_turned_right": ("environment", changed("environment", lambda x: np.roll(x, -8, 1))),
    "if_turned_left": ("environment", changed("environment", lambda x: np.roll(x, 8, 1))),
    "if_mirrored_and_turned": ("environment", changed("environment", lambda x: np.roll(x[:, ::-1], 16, 1))),
    "if_mirrored_and_turned_right": ("environment", changed("environment", lambda x: np.roll(x[:, ::-1], 8, 1))),
    "if_mirrored_and_turned_left": ("environment", changed("environment", lambda x: np.roll(x[:, ::-1], -8, 1))),
    "if_inverted": ("roughness", changed("roughness", lambda x: 1 - x)),
    "if_root": ("roughness", changed("roughness", np.square)),
    "if_swapped": ("roughness", exchanged),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_usual_mistake_that_is_undone_gains_most(mistake: str) -> None:
    """Whichever it is, the note names it and no other; of three pictures it says nothing."""
    quantity, make = MADE[mistake]
    truth = intrinsics(0).replace(diffuse=intrinsics(1).diffuse)
    values = score_maps(make(truth), truth) | suspicions(asked(truth), None, make(truth))
    gains = {key: gain for key, gain in values.items() if key.startswith(f"{quantity}.if_")}
    assert gains.pop(metric_key(quantity, GAINS[mistake])) == MOST_DB
    assert max(gains.values(), default=0) < 15
    records = [Record("inverse", "single-image", "m", f"s{i}", f"o{i}", values) for i in range(4)]
    said = mistakes_said(records)
    assert said.startswith(f"its answers are nearer to the truth {MISTAKES[mistake].said}: ")
    assert said.endswith(" (4 of 4, +20.0 dB)")
    assert mistakes_said(records[:3]) == ""


def test_what_is_sound_gains_nothing() -> None:
    truth = intrinsics(0).replace(diffuse=intrinsics(1).diffuse)
    assert max(gain for key, gain in suspicions(asked(truth), None, truth).items() if ".if_" in key) < 0
    albedo = truth.require("albedo")["albedo"]
    noise = np.random.default_rng(2).normal(0, 0.2, (*albedo.shape[:2], 1))
    noisy = truth.replace(albedo=np.clip(albedo + noise, 0, 1))
    assert suspicions(asked(truth), None, noisy)["albedo.if_decoded"] < 0


def test_an_albedo_of_another_brightness_is_not_taken_for_one_that_was_decoded_twice() -> None:
    """A dark one is nearer to the truth when it is encoded, and so it is at the right brightness."""
    truth = intrinsics(0)
    dark = truth.replace(albedo=truth.require("albedo")["albedo"] * np.float32(0.1))
    assert suspicions(asked(truth), None, dark)["albedo.if_encoded"] < 0


def test_maps_that_no_picture_tells_are_noted() -> None:
    def records(db: float, degrees: float, **gains: float) -> list[Record]:
        values = {"albedo.psnr@masked-srgb-raw": db, "normal.angle_deg": degrees}
        values |= {f"{name}.if_shifted": gain for name, gain in gains.items()}
        return [Record("inverse", "single-image", "m", f"s{i}", f"o{i}", values) for i in range(4)]

    said = (
        "its answers are the truth but for rounding: albedo (4 of 4 pictures), normal (4 of 4 pictures) (was it told?)"
    )
    assert truth_said(records(math.inf, 0.1, albedo=-20.0, normal=-20.0)) == said
    few = records(math.inf, 0.1, albedo=-20.0)[:3]
    assert truth_said(records(40.0, 1.0, albedo=-9.0, normal=-9.0)) == truth_said(few) == ""
    assert truth_said(records(math.inf, 0.1)) == "", "no stranger's"
    told = records(40.0, 1.0, roughness=-9.0)
    for right, said in ((3, ""), (4, "metallic (4 of 4 pictures)")):  # a constant is right on some pictures
        errors = [{metric_key("metallic", "mse"): float(i >= right)} for i in range(4)]
        made = [replace(r, values={**r.values, **error}) for r, error in zip(told, errors, strict=True)]
        assert said in truth_said(made)
        assert bool(said) == bool(truth_said(made))


def test_pictures_and_lights_have_gains_and_nothing_has_none_of_its_own() -> None:
    truth = intrinsics(0)
    picture = truth.require("albedo")["albedo"] * truth.require("mask")["mask"]
    found = suspicions(asked(truth, picture), np.ascontiguousarray(picture[..., ::-1]), None)
    assert max(found, key=lambda key: found[key]) == "relit.if_bgr"
    assert suspicions(asked(truth, picture), None, None) == {}
    assert suspicions(asked(truth), None, Intrinsics(environment=np.zeros((16, 32, 3)))) == {}


def test_absent_maps_have_no_values() -> None:
    prediction = intrinsics(1).replace(albedo=None, environment=None, normal=None)
    values = score_maps(prediction, intrinsics(0))
    assert values
    assert not [key for key in values if key.startswith(("albedo", "environment", "normal"))]


def white(x: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Over white."""
    return x * mask + 1 - mask


def test_colours_by_hand() -> None:
    """Every variant: masked, SSIM looks at composites with the true mask, and weights by it."""
    prediction, truth, w, own = intrinsics(1).maps, intrinsics(0).maps, disc(), disc(6)
    values = score_maps(intrinsics(1).replace(mask=own), intrinsics(0))
    for name in ("albedo", "specular", "diffuse"):
        t = truth[name]
        for scale in SCALES:
            p = metrics.align_scale(prediction[name], t, w, scale)
            for space, shown in (("srgb", image_srgb), ("linear", lambda x: np.clip(x, 0, 1))):
                expected = {
                    f"psnr@masked-{space}-{scale}": metrics.psnr(shown(p), shown(t), w),
                    f"psnr@whole-{space}-{scale}": metrics.psnr(shown(white(p, own)), shown(white(t, w))),
                    f"ssim@masked-{space}-{scale}": ssim(shown(white(p, w)), shown(white(t, w)), w),
                    f"ssim@whole-{space}-{scale}": ssim(shown(white(p, own)), shown(white(t, w))),
                }
                found = {key: values[f"{name}.{key}"] for key in expected}
                assert found == pytest.approx(expected, rel=1e-6, abs=1e-7), name
                assert len(set(found.values())) == 4
            kind, distance = ("ciede2000", metrics.ciede2000) if name == "albedo" else ("log_rmse", metrics.log_rmse)
            assert values[f"{name}.{kind}@{scale}"] == pytest.approx(distance(p, t, w), rel=1e-6)


@pytest.mark.parametrize("own", [disc(6), None])
def test_lpips_by_hand(own: np.ndarray | None) -> None:
    """Of unaligned whole frames: masked, with the true mask; else with the method's own."""
    network, w = load("alex"), disc()
    p, t = (intrinsics(seed).maps["albedo"] for seed in (1, 0))
    values = score_colour("relit", p, t, w, w if own is None else own, SCALES, [network])
    truth = image_srgb(white(t, w))[None]
    masked, whole = (
        float(network.distance(image_srgb(white(p, m))[None], truth)[0]) for m in (w, w if own is None else own)
    )
    found = {key: value for key, value in values.items() if "lpips" in key}
    expected = {"relit.lpips_alex@masked-raw": masked, "relit.lpips_alex@whole-raw": whole}
    assert found == pytest.approx(expected, abs=1e-6)
    assert (masked == whole) == (own is None)


def test_what_the_machine_is_too_small_for_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 4k pictures a process ended without a word."""
    picture, mask = np.zeros((1024, 1024, 3), np.float32), np.ones((1024, 1024, 1), np.float32)
    monkeypatch.setattr("unirender.system.machine.memory_bytes", lambda: 6e8)
    with pytest.raises(UnirenderError, match=r"scoring relit: 1\.05 megapixels, which would take about 0\.7 GiB of"):
        score_image(picture, picture, mask)
    with pytest.raises(UnirenderError, match=r"scoring maps: .* about 1\.0 GiB .*scale both sides down, or leave out"):
        score_maps(Intrinsics(mask=mask), Intrinsics(mask=mask), lpips=[load("alex")])


def test_materials_and_normals_by_hand() -> None:
    prediction, truth, w, own = intrinsics(1).maps, intrinsics(0).maps, disc(), disc(6)
    values = score_maps(intrinsics(1).replace(mask=own), intrinsics(0))
    for name in MATERIALS:
        p, t = prediction[name], truth[name]
        assert values[f"{name}.mse@masked"] == pytest.approx(np.average((p - t) ** 2, weights=w))
        assert values[f"{name}.mse@whole"] == pytest.approx(np.mean((p * own - t * w) ** 2))
        means = (np.average(x, weights=w) for x in (p, t))
        assert values[f"{name}.mse_object"] == pytest.approx((next(means) - next(means)) ** 2, rel=1e-4)
    cosine = np.clip((prediction["normal"] * truth["normal"]).sum(axis=-1), -1, 1)
    assert values["normal.cosine"] == pytest.approx(np.average(cosine, weights=w[..., 0]), rel=1e-5)
    angle = np.average(np.degrees(np.arccos(cosine)), weights=w[..., 0])
    assert values["normal.angle_deg"] == pytest.approx(angle, rel=1e-4)


def test_a_mask_of_ones_own_changes_the_whole_frame_and_not_the_masked_figures() -> None:
    truth = intrinsics(0)
    pasted = score_maps(intrinsics(1).replace(mask=None), truth)
    same = score_maps(intrinsics(1), truth)
    small = intrinsics(1).replace(mask=disc(6))
    own = score_maps(small, truth)
    assert pasted == same
    assert own["albedo.psnr@whole-srgb-raw"] < pasted["albedo.psnr@whole-srgb-raw"]
    for key in ("albedo.psnr@masked-srgb-raw", "albedo.ssim@masked-linear-raw", "roughness.mse@masked"):
        assert own[key] == pasted[key]
    assert OWN_MASK not in pasted
    assert own[OWN_MASK] == pytest.approx(disc(6).sum() / disc().sum())  # one disc in the other


def test_the_given_mask_after_8_bits_is_no_mask_of_ones_own() -> None:
    truth, step = intrinsics(0), np.float32(1 / 255)
    pasted = score_maps(intrinsics(1).replace(mask=None), truth)
    for stored in (np.round(disc() * 255) / 255, np.maximum(disc() - 0.999 * step, 0), disc().astype(np.float16)):
        assert score_maps(intrinsics(1).replace(mask=stored.astype(np.float32)), truth) == pasted
    rough = score_maps(intrinsics(1).replace(mask=np.maximum(disc() - 1.01 * step, 0)), truth)
    assert 0.9 < rough[OWN_MASK] < 1


def test_images_are_premultiplied() -> None:
    truth = intrinsics(0)
    assert truth.diffuse is not None
    image = truth.diffuse * disc()
    np.testing.assert_allclose(unpremultiply(image, disc()), truth.diffuse, atol=1e-6)
    assert score_image(image, image, disc())["relit.psnr@masked-srgb-raw"] == math.inf
    noisy = image + 0.1 * disc()
    values = score_image(noisy, image, disc(), quantity="edit_metallic")
    expected = metrics.psnr(image_srgb(truth.diffuse + 0.1 * (disc() > 0)), image_srgb(truth.diffuse), disc())
    assert values["edit_metallic.psnr@masked-srgb-raw"] == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("mask", [None, np.zeros((SIZE, SIZE, 1), np.float32)])
def test_a_truth_without_an_object_is_refused(mask: np.ndarray | None) -> None:
    with pytest.raises(UnirenderError, match="mask"):
        score_maps(intrinsics(1), intrinsics(0).replace(mask=mask))


def test_nan_is_refused() -> None:
    image = np.full((SIZE, SIZE, 3), np.nan, np.float32)
    with pytest.raises(UnirenderError, match="NaN"):
        score_image(image, np.zeros_like(image), disc())


@pytest.mark.parametrize("name", ["albedo", "roughness", "normal"])
def test_another_size_is_refused(name: str) -> None:
    small = Intrinsics().replace(**{name: intrinsics(1).maps[name][:16, :16]})
    with pytest.raises(UnirenderError, match=f"scoring {name}: got shapes .* resample the prediction"):
        score_maps(small, intrinsics(0))
