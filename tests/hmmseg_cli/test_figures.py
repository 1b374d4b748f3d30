"""Figures are drawn, whole and from awkward results too, and say what they should."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.image import imread
from matplotlib.text import Text

from estimation.plots import Prediction, draw_corner, draw_estimates, draw_predictive
from hmmseg.contact.decompose import subtasks
from hmmseg.hand.signals import Signals
from hmmseg.io.task import BlockTask, Move
from hmmseg.io.trial import Trial
from hmmseg.plot import style as drawing
from hmmseg.plot.spans import MOST, draw_channels, draw_signals
from hmmseg.segmentation.spans import Failure, Segmentation, Span

T = np.arange(100) * 0.05
NAMES = [("block1", "weight"), ("block1", "width"), ("block1", "height")]
PROPERTIES = {"block1": {"weight": {"unit": "N", "mean": 0.35, "sd": 0.01, "interval_68": [0.34, 0.36],
                                    "interval_95": [0.33, 0.37]}, "width": None,
                         "friction": {"lower_bound": 0.5}}}  # fmt: skip


@pytest.fixture
def texts(monkeypatch):
    """Every text of the figures drawn, gathered as they are saved."""
    found: list[str] = []
    save = drawing.Figure.savefig

    def gather(figure, *args, **kwargs):
        save(figure, *args, **kwargs)
        found.extend(text.get_text() for text in figure.findobj(Text))

    monkeypatch.setattr(drawing.Figure, "savefig", gather)
    return found


def make_segmentation() -> Segmentation:
    steps, sd = subtasks(BlockTask({"block": "ground"}, (Move("block", "ground"),))), 0.01
    spans = tuple(
        Span(s.name, s.object, s.state, 1.0 * i, i + 1.0, sd, sd, (i - 0.02, i + 0.02), (i + 0.98, i + 1.02))
        for i, s in enumerate(steps)
    )
    return Segmentation("made.csv", 20.0, None, spans)


def make_signals() -> Signals:
    channels = set(Signals.__dataclass_fields__) - {"t", "sd_force", "derived", "touches"}
    values = {name: np.sin(T) for name in channels}
    return Signals(t=T, **values, sd_force=0.01)


def check_picture(path) -> None:
    """A PNG file that is neither empty nor one colour."""
    picture = imread(path)
    assert min(picture.shape[:2]) > 200 and np.std(picture[..., :3]) > 0.02


def test_signals_show_subtasks_and_where_a_trial_failed(tmp_path, texts):
    path = tmp_path / "signals.png"
    draw_signals(make_signals(), make_segmentation(), path)
    check_picture(path)
    assert {"pregrasp block", "carry block", "hold-above-ground", "Grip\n[N]", "Mean $x$\n[cm]"} <= set(texts)
    segmentation = make_segmentation()
    failed = replace(segmentation, spans=segmentation.spans[:1], failed=Failure(1, "pickup", "block", "none"))
    gappy = replace(make_signals(), fx1=np.where(np.arange(100) % 2, np.nan, 1.0), x1=np.full(100, np.nan))
    draw_signals(gappy, failed, tmp_path / "failed.png")
    draw_signals(gappy, replace(failed, spans=()), tmp_path / "empty.png")
    assert "does not fit its task at pickup block" in texts
    check_picture(tmp_path / "empty.png")


def test_channels_of_a_plain_task_up_to_what_is_legible(tmp_path, texts):
    spans = tuple(replace(s, object=None, state=s.subtask) for s in make_segmentation().spans)
    trial = Trial("made.csv", T, {f"c{i}": np.cos(i * T) for i in range(MOST + 3)})
    draw_channels(trial, Segmentation("made.csv", 20.0, 1.0, spans), tmp_path / "channels.png")
    check_picture(tmp_path / "channels.png")
    assert "c11" in texts and "c12" not in texts and "pickup" in texts
    assert any("3 more channels not shown" in text for text in texts)


def test_corners_show_cm_and_predictions_their_coverage(tmp_path, texts):
    draws = np.random.default_rng(0).normal([0.343, 0.0159, 0.016], [1e-3, 1e-4, 1e-4], (2000, 3))
    actual = {"block1": {"weight": (0.5, 0.001), "width": (0.0159, 0.0001)}}
    draw_corner(draws, NAMES, tmp_path / "corner.png", actual)
    check_picture(tmp_path / "corner.png")
    assert {"block1\nwidth [cm]", "block1\nweight [N]", "lines: measured"} <= set(texts)
    assert "measured 0.5" in texts  # too far off to be a line
    draw_corner(draws[:, :1], NAMES[:1], tmp_path / "one.png")
    check_picture(tmp_path / "one.png")
    low = np.where(T > 2.5, np.nan, -0.5)
    prediction = Prediction("Net $f_y$ [N]", np.sin(T), low, low + 1.0)
    there = T <= 2.5
    assert prediction.coverage == pytest.approx(np.mean(np.sin(T[there]) <= 0.5))
    nothing = replace(prediction, low=np.full(100, np.nan))
    assert np.isnan(nothing.coverage)
    draw_predictive(T, [prediction, nothing], tmp_path / "predictive.png", make_segmentation())
    check_picture(tmp_path / "predictive.png")
    assert sum(text.endswith("% inside") for text in texts) == 1


@pytest.mark.parametrize("actual", [None, {"block1": {"weight": (0.343, 0.0005), "width": (0.0159, 0.0001)}}])
def test_estimates_with_null_and_bounded_properties(tmp_path, texts, actual):
    draw_estimates(PROPERTIES, actual, tmp_path / "estimates.png")
    check_picture(tmp_path / "estimates.png")
    assert {" not determined ", " lower bound only ", "≥ 0.50", "block1 weight"} <= set(texts)
    assert ("0.350 ± 0.010 N" if actual is None else "0.350 ± 0.010 N  (0.3430)") in texts
