"""Differences over objects and lights: which light a sample counts for, and both intervals side by side."""

import pytest
from small_results import small_results

from unirender.errors import UnirenderError
from unirender_evaluation.results.findings import NOT_RUN, Question
from unirender_evaluation.results.lights import light_of, over_lights

LIGHTS = {"ball-0_l0": "sun", "ball-0_l1": "sky", "ball-1_l0": "sky", "ball-1_l1": "lamp", "ball-1_l0_l0": "moon"}


def test_a_sample_counts_for_the_light_of_what_is_scored() -> None:
    samples = ["ball-0_l0", "ball-0_l0_m050_r010", "ball-0_l0_to_l1", "ball-1_l1_to_l0", "ball-1_l0_l0_textured"]
    assert [light_of(sample, LIGHTS) for sample in samples] == ["sun", "sun", "sky", "sky", "moon"]
    for stranger in ("ball-0_l01", "cup_l0_m050_r010", "ball-0_l0_to_l7"):
        with pytest.raises(UnirenderError, match=f"{stranger!r} belongs to none of the 5 scenes"):
            light_of(stranger, LIGHTS)


def test_both_intervals_stand_beside_the_difference() -> None:
    asked = [
        Question("albedo", "inverse", "single-image", "albedo", "psnr", "ours-mean", "input-as-albedo"),
        Question("albedo", "inverse", "single-image", "albedo", "psnr", "ours-mean", "nobody"),
    ]
    line, other = over_lights(small_results(), asked, LIGHTS).splitlines()[2:]
    cells = [cell.strip() for cell in line.replace("\N{NO-BREAK SPACE}", " ").strip("|").split("|")]
    assert cells[1:] == ["Ours (mean)", "input as albedo", "+8.00", *["[+8.00, +8.00]"] * 2, "4 (2, 3)"]
    assert NOT_RUN in other
