"""What settings come to on a capture: the numbers of the statistics, and the warnings before the first step."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train.preflight import facts, find_warnings
from pop_fast.train.views import ViewTensors
from tests.app.tiny import tiny_capture, tiny_config


def a_view(
    width: int, height: int, mask: torch.Tensor | None = None, moved: tuple[float, float] = (0.0, 0.0)
) -> ViewTensors:
    photo = torch.zeros((height, width, 3), dtype=torch.uint8)
    K = torch.eye(3)[None].clone()
    K[0, 0, 2], K[0, 1, 2] = width / 2 + moved[0], height / 2 + moved[1]
    return ViewTensors("a.jpg", photo, mask, torch.eye(4)[None], K)


def said_of(width: int = 980, height: int = 545, **settings: object) -> list[str]:
    return list(find_warnings(TrainConfig.of(**settings), [a_view(1600, 1200), a_view(width, height)]))


def test_the_papers_schedule_on_the_papers_images_raises_no_doubt():
    assert [said_of(method=method) for method in ("pop", "gsplat", "3dgs")] == [[], [], []]


def test_small_images_need_a_least_number_of_pixels():
    (warning,) = said_of(480, 270)
    assert "theta_blur is 2.6 pixels of a.jpg (480 x 270)" in warning
    assert "--pop.blur-min-pixels 10" in warning
    # what it names fixes it; quick has it; and where nothing grows by blur there is nothing to fix
    assert said_of(480, 270, **{"pop.blur_min_pixels": 10}) == []
    assert said_of(480, 270, preset="quick") == []
    assert said_of(480, 270, **{"pop.blur_stop_iter": -1}) == []
    assert said_of(480, 270, method="gsplat") == []


def test_a_mask_makes_a_view_as_small_as_what_it_keeps():
    mask = torch.zeros((545, 980), dtype=torch.bool)
    mask[:100] = True
    (warning,) = find_warnings(TrainConfig.of(), [a_view(980, 545, mask)])
    assert "theta_blur is 2.0 pixels" in warning


@pytest.mark.parametrize("method", ["gsplat", "3dgs"])
def test_a_short_schedule_has_no_resets_unless_they_are_asked_for(method):
    assert said_of(method=method, preset="quick") == []
    (warning,) = said_of(method=method, preset="quick", **{f"{method}.reset_every": 300})
    assert "reset after step 300 and have 300 steps (3 densification steps) to recover" in warning
    assert f"--{method}.reset-every 0" in warning
    assert said_of(method=method, preset="quick", **{f"{method}.reset_every": 0}) == []


def test_a_centred_principal_point_is_warned_of_where_the_cameras_have_another():
    away = [a_view(512, 512), a_view(512, 512, moved=(3.0, -4.0))]
    (warning,) = find_warnings(TrainConfig.of(method="3dgs"), away)
    assert "a.jpg lies 5.0 pixels from there" in warning
    assert "--profile gsplat_1_5" in warning
    assert list(find_warnings(TrainConfig.of(method="3dgs", profile="gsplat_1_5"), away)) == []
    assert list(find_warnings(TrainConfig.of(method="gsplat"), away)) == []
    assert list(find_warnings(TrainConfig.of(method="3dgs"), [a_view(512, 512, moved=(0.6, 0.6))])) == []


def test_a_run_that_ends_soon_after_a_reset_is_warned_of():
    (warning,) = said_of(method="gsplat", max_steps=6500)
    assert "reset after step 6,000 and have 500 steps" in warning
    assert said_of(method="gsplat", steps_scaler=2.0) == []


def test_warnings_come_before_the_first_step_also_without_a_terminal(tmp_path, capsys, monkeypatch):
    before: list[str] = []

    def stops(training: TrainingRun, last: int) -> None:
        before.append(capsys.readouterr().err)
        raise KeyboardInterrupt

    monkeypatch.setattr(TrainingRun, "take_steps", stops)
    strategy = replace(tiny_config(tmp_path).strategy, theta_blur=1e-4)
    with pytest.raises(KeyboardInterrupt):
        TrainingRun(tiny_config(tmp_path, strategy=strategy), tiny_capture()).run()
    assert before[0].startswith("warning: theta_blur is 0.1 pixels of ")


def test_statistics_name_what_decides_a_comparison(tmp_path):
    views = [a_view(480, 270), a_view(960, 540)]
    quick = facts(TrainConfig.of(preset="quick"), views)
    assert quick["theta_blur_pixels"] == pytest.approx([2.592, 10.368])
    del quick["theta_blur_pixels"]
    named = {
        "method": "pop",
        "preset": "quick",
        "seed": 42,
        "lambda_pop": 0.001,
        "blur_min_pixels": 10.0,
        "blur_events": 5,
    }
    assert quick == named
    assert facts(TrainConfig.of(), views)["blur_events"] == 41
    assert facts(TrainConfig.of(method="gsplat"), views)["blur_events"] == 0
    assert facts(TrainConfig.of(max_steps=3100), views)["blur_events"] == 1
    stats = TrainingRun(tiny_config(tmp_path, max_steps=1), tiny_capture()).run()
    assert {"method", "preset", "seed", "lambda_pop", "theta_blur_pixels", "blur_min_pixels", "blur_events"} <= set(
        stats
    )
