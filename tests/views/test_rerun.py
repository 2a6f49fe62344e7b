"""The Rerun view: what is in the file equals the calibration, and the file opens as a picture with something in it."""

import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers.paths import ROOT
from screenshot import ScreenshotError, screenshot, viewer

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench, axes_of
from kf_calib.bench.streams import Batch, Stream
from kf_calib.diagnosis.missing_effect import diagnose
from kf_calib.diagnosis.stepwise_selection import Improvement
from kf_calib.errors import InputError
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.filter_history import nis_band
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.settings import PRIORS, Settings
from kf_calib.support.units import rounded, shown
from kf_calib.views import rerun as view
from kf_calib.views.rerun import markdown_summary
from kf_calib.views.rerun.names import path_of
from kf_calib.views.rerun.spheres import FINAL_SIZE, ellipsoids_of, magnification

STEP_NS = 10_000_000
MOVE_NS = 2_000_000_000


class Dwells:
    """A source of still dwells at random orientations, readings linear in the specific force."""

    def __init__(self, count: int, bench: Bench, samples: int = 300, sigma_mps2: float = 1e-4) -> None:
        self.bench, self.warnings, self.fraction = bench, list[str](), 1.0
        random = np.random.default_rng(7)
        state = paper_parameters.state_of(paper_parameters.nominal() + 1e-3 * random.normal(size=12)).reshape(3, 4)
        accel, pose, at_ns = list[Stream](), list[Stream](), 0
        for _ in range(count):
            time_ns = at_ns + STEP_NS * np.arange(samples)
            own = _pose(bench, random)
            force = bench.specific_force(time_ns / 1e9, np.repeat(own[None], samples, axis=0))
            noise = sigma_mps2 * random.normal(size=(samples, 3))
            accel.append(Stream(time_ns, force @ state[:, :3].T + state[:, 3] + noise))
            pose.append(Stream(time_ns[::10], np.repeat(own[None], len(time_ns[::10]), axis=0)))
            at_ns = int(time_ns[-1]) + MOVE_NS
        self.batch = Batch(_joined(accel), _joined(pose))

    def __iter__(self) -> Iterator[Batch]:
        yield self.batch


def _pose(bench: Bench, random: np.random.Generator) -> Floats:
    if bench.axes:
        return random.uniform(-3, 3, size=3)
    quaternion = random.normal(size=4)
    return quaternion / np.linalg.norm(quaternion)


def _joined(streams: list[Stream]) -> Stream:
    return Stream(np.concatenate([s.time_ns for s in streams]), np.concatenate([s.values for s in streams]))


GIMBALS = Bench(axes=axes_of("yzx"), gravity_mps2=9.81, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0)
ATTITUDE = Bench(axes=(), gravity_mps2=9.81, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0)
INERTIAL = Bench(
    axes=axes_of("yzx"), gravity_mps2=9.81, reference="inertial", latitude_deg=50.0, angle_sigma_deg=0.0,
    scatter_sigma_mps2=0.0,
)  # fmt: skip


@pytest.fixture(scope="module")
def result() -> Calibration:
    return calibrate(Dwells(12, GIMBALS))


@pytest.fixture(scope="module")
def recording(result: Calibration, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return view.save_view(result, tmp_path_factory.mktemp("view") / "run.rrd")


Rows = list[tuple[float | None, int | None, list]]


def rows_of(path: Path, component: str = "Scalars:scalars") -> dict[str, Rows]:
    """(bench time in s, orientation, values) of every entity, in the order of the bench time."""
    from rerun.chunk import RrdReader

    out = defaultdict[str, Rows](list)
    for chunk in RrdReader(path).stream():
        columns = chunk.to_record_batch().to_pydict()
        if component not in columns:
            continue
        times = columns.get(view.BENCH_TIME, [None])
        numbers = columns.get(view.ORIENTATION, [None] * len(times))
        for time, orientation, values in zip(times, numbers, columns[component], strict=True):
            out[chunk.entity_path].append((None if time is None else time.total_seconds(), orientation, values))
    return {entity: sorted(rows, key=lambda row: (row[0] is not None, row[0])) for entity, rows in out.items()}


def by_orientation(rows: Rows) -> dict[int, list]:
    return {number: values for _, number, values in rows if number is not None}


@pytest.mark.parametrize("symbol", paper_parameters.SYMBOLS)
def test_parameters_are_those_of_the_trace(result: Calibration, recording: Path, symbol: str) -> None:
    k = paper_parameters.SYMBOLS.index(symbol)
    scalars, factor = rows_of(recording), shown(paper_parameters.UNITS[k]).per_si
    trace = [(t, e.parameters[k], e.sigma[k]) for t, _, e in result.trace() if not e.unseen[k]]
    sigma = scalars[f"/{path_of(symbol)}/sigma"]
    np.testing.assert_allclose([row[0] for row in sigma], [t for t, _, _ in trace], atol=1e-9)
    np.testing.assert_allclose([row[2][0] for row in sigma], [s * factor for _, _, s in trace], rtol=1e-9)
    nominal = paper_parameters.nominal(result.bench.nominal)[k]
    band = np.array([row[2] for row in scalars[f"/{path_of(symbol)}/band"]])
    np.testing.assert_allclose(band.mean(axis=1), [(v - nominal) * factor for _, v, _ in trace], rtol=1e-9, atol=1e-7)
    np.testing.assert_allclose(np.ptp(band, axis=1) / 2, [s * factor for _, _, s in trace], rtol=1e-6)


def test_one_point_an_orientation_and_none_before_it_is_determined(result: Calibration, recording: Path) -> None:
    whole = by_orientation(rows_of(recording)["/parameters/a1/K1/sigma"])
    seen = [k for k, visit in enumerate(result.visits, 1) if not visit.estimate.unseen[2]]
    assert list(whole) == seen
    assert 1 not in seen
    assert whole[12][0] == pytest.approx(result.estimate.sigma[2] * 1e6)


def test_innovations_and_nis_are_those_of_the_visits(result: Calibration, recording: Path) -> None:
    scalars = rows_of(recording)
    judged = {k: visit for k, visit in enumerate(result.visits, 1) if np.isfinite(visit.innovation_mps2).all()}
    for i in range(3):
        value = by_orientation(scalars[f"/innovation/a{i + 1}/value"])
        bound = by_orientation(scalars[f"/innovation/a{i + 1}/bound"])
        assert list(value) == list(bound) == list(judged)
        for k, visit in judged.items():
            assert value[k][0] == pytest.approx(visit.innovation_mps2[i] * 1e6 / 9.80665)
            assert bound[k] == pytest.approx(np.array([-2e6, 2e6]) / 9.80665 * visit.innovation_sigma_mps2[i])
    nis = by_orientation(scalars["/nis/value"]) | by_orientation(scalars.get("/nis/above", []))
    assert {k: v[0] for k, v in nis.items()} == pytest.approx(
        {k: visit.nis for k, visit in enumerate(result.visits, 1) if visit.dof > 0}
    )


def test_poses_are_those_of_the_visits(result: Calibration, recording: Path) -> None:
    scalars = rows_of(recording)
    for k, axis in enumerate("yzx"):
        angles = by_orientation(scalars[f"/bench/pose/{k + 1}_{axis}"])
        apart = [angles[n][0] - np.degrees(visit.dwell.pose[k]) for n, visit in enumerate(result.visits, 1)]
        np.testing.assert_allclose((np.array(apart) + 180) % 360, 180, atol=1e-9)


def test_axes_point_where_the_estimate_says(result: Calibration, recording: Path) -> None:
    axes = by_orientation(rows_of(recording, "Arrows3D:vectors")["/platform/axes"])
    sensitivity = result.estimate.state.reshape(3, 4)[:, :3]
    expected = sensitivity / np.linalg.norm(sensitivity, axis=1, keepdims=True)
    np.testing.assert_allclose(axes[12], expected, atol=1e-6)
    assert axes[1] == []
    spread = by_orientation(rows_of(recording, "Ellipsoids3D:half_sizes")["/platform/uncertainty"])
    factor = magnification(ellipsoids_of(result.estimate))
    assert factor is not None
    largest = max(np.sqrt(np.linalg.eigvalsh(result.estimate.covariance[i : i + 3, i : i + 3])[-1]) for i in (0, 4, 8))
    assert np.max(spread[12]) == pytest.approx(factor * largest, rel=1e-5)
    assert 0.4 * FINAL_SIZE <= np.max(spread[12]) <= FINAL_SIZE


def test_summary_holds_every_parameter_and_every_warning(result: Calibration) -> None:
    text = markdown_summary(result)
    for parameter in result.parameters.values():
        assert parameter.value is not None and parameter.sigma is not None
        if parameter.unit == "1":
            assert rounded(parameter.value, parameter.sigma)[0] in text
    assert all(warning in text for warning in result.warnings)
    assert "Model and measurements agree" in text


@pytest.mark.parametrize("bench", [ATTITUDE, INERTIAL], ids=["attitude", "inertial"])
def test_other_benches(bench: Bench, tmp_path: Path) -> None:
    path = view.save_view(calibrate(Dwells(8, bench)), tmp_path / "run.rrd")
    assert "/parameters/a3/b3/sigma" in rows_of(path)


def test_a_prior_is_orientation_zero_and_one_dwell_is_enough(tmp_path: Path) -> None:
    result = calibrate(Dwells(1, GIMBALS), Settings(prior=PRIORS["navigation"]))
    path = view.save_view(result, tmp_path / "run.rrd")
    sigma = by_orientation(rows_of(path)["/parameters/a2/b2/sigma"])
    assert list(sigma) == [0, 1]
    assert sigma[0][0] == pytest.approx(2e-2 * 1e6 / 9.80665)


def test_four_orientations_leave_nothing_to_judge(tmp_path: Path) -> None:
    path = view.save_view(calibrate(Dwells(4, GIMBALS)), tmp_path / "run.rrd")
    assert not any("/nis/" in entity for entity in rows_of(path))


@pytest.mark.parametrize("dwells", [1, 4, 9])
def test_diagnoses_and_improvements_of_odd_runs(tmp_path: Path, dwells: int) -> None:
    """Nothing varies, nothing to judge by, attitude recorded."""
    bench = GIMBALS if dwells < 9 else ATTITUDE
    found = diagnose(calibrate(Dwells(dwells, bench), Settings(prior=PRIORS["navigation"])))
    for made in (found, Improvement(found)):
        assert view.save_view(made, tmp_path / "odd.rrd").stat().st_size > 10_000


def test_strict_mode_of_the_caller_is_given_back(result: Calibration, tmp_path: Path) -> None:
    import rerun

    before = rerun.strict_mode()
    view.save_view(result, tmp_path / "run.rrd")
    assert rerun.strict_mode() is before


def test_a_folder_that_is_not_there(result: Calibration, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no folder"):
        view.save_view(result, tmp_path / "nowhere" / "run.rrd")


def _drawn(recording: Path, picture: Path, **options) -> np.ndarray:
    """The picture's pixels (h, w, 3)."""
    from PIL import Image

    screenshot(recording, picture, (1200, 800), **options)
    return np.asarray(Image.open(picture).convert("RGB"))


def test_without_a_graphics_driver_it_says_what_to_install(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As it is for any test that does not say that it draws."""
    monkeypatch.setattr("screenshot._IDLE_S", 0.0)  # as on a busy machine: it listens, and ends later
    with pytest.raises(ScreenshotError, match="mesa-vulkan-drivers"):
        screenshot(recording, tmp_path / "x.png")


@pytest.mark.draws
def test_a_file_that_is_no_recording(tmp_path: Path) -> None:
    (tmp_path / "bad.rrd").write_text("no recording")
    with pytest.raises(ScreenshotError, match="nothing that Rerun can show"):
        _drawn(tmp_path / "bad.rrd", tmp_path / "x.png")


@pytest.mark.draws
def test_it_opens_as_a_picture(recording: Path, tmp_path: Path) -> None:
    shown = _drawn(recording, tmp_path / "run.png")
    assert shown.shape == (800, 1200, 3)
    assert len(np.unique(shown.reshape(-1, 3), axis=0)) > 500
    for colour in ((235, 115, 40), (40, 185, 130), (85, 160, 245)):  # the curves of each accelerometer
        assert (np.abs(shown.astype(int) - colour).max(axis=2) < 12).sum() > 300
    early = _drawn(recording, tmp_path / "early.png", timeline=view.ORIENTATION, time=3)
    assert (early != shown).any(axis=2).mean() > 0.003  # ellipsoids, and the cursor in each panel


@pytest.mark.draws
def test_no_panel_complains(recording: Path) -> None:
    from rerun.experimental import ViewerClient

    with viewer(recording, (1200, 800)) as client:
        assert isinstance(client, ViewerClient)
        client.take_screenshot()
        state = client.get_state()
    assert [(shown.name, report.summary) for shown in state.views for report in shown.reports] == []
    names = {shown.name for shown in state.views}
    assert names >= {"result", "gimbal angles, deg", "innovations over σ", "K₁ − nominal ± σ, ppm"}


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("none.rrd", {}, "no recording"),
        pytest.param("run.rrd", {"timeline": "none", "time": 1.0}, "no timeline", marks=pytest.mark.draws),
    ],
)
def test_screenshots_that_cannot_be(recording: Path, tmp_path: Path, name: str, options: dict, message: str) -> None:
    with pytest.raises(ScreenshotError, match=message):
        _drawn(recording.parent / name, tmp_path / "x.png", **options)


def test_without_rerun_a_replay_works_and_a_view_says_what_to_install(tmp_path: Path) -> None:
    code = (
        "import sys; sys.modules.pop('rerun', None)\n"
        "from importlib.machinery import PathFinder\n"
        "real = PathFinder.find_spec\n"
        "PathFinder.find_spec = classmethod(lambda cls, name, path=None, target=None:"
        " None if name.partition('.')[0] in ('rerun', 'pyarrow') else real(name, path, target))\n"
        "from kf_calib.cli import main; sys.argv[0] = 'kf-calib'; main()"
    )
    recording = str(ROOT / "recordings" / "hidden.mcap")
    for words, status, said in (((), 0, ""), (("--rrd", str(tmp_path / "x.rrd")), 2, "pip install rerun-sdk")):
        command = [sys.executable, "-c", code, "replay", recording, "--json", *words]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
        assert done.returncode == status and said in done.stderr and len(done.stderr.splitlines()) == bool(said)


def test_the_middle_of_chi_squared() -> None:
    np.testing.assert_allclose(nis_band(np.array([3])), [[0.2158, 9.3484]], atol=1e-4)
