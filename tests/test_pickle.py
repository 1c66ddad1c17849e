# SPDX-License-Identifier: Apache-2.0
"""Settings, sensors and results go to another process and back, also sensors from a file of a user."""

from __future__ import annotations

import pickle
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from small_result import SCENES, small_result

from rangesim import Rig, load_capture
from rangesim.experiment import Experiment, ScanSettings, Turntable
from rangesim.instrument.instrument import Instrument
from rangesim.motion import ConstantTwist, Motion
from rangesim.presets import instrument
from rangesim.results.experiment_results import load_result
from rangesim.sensors import sensor_of

ROOT = Path(__file__).resolve().parents[1]
OWN = ROOT / "examples" / "own_sensor.py"

UNPICKLE = """
import pickle, sys
thing = pickle.load(open(sys.argv[1], "rb"))
pickle.dump(thing, open(sys.argv[2], "wb"))
print(type(thing).__name__)
"""


def through_another_process(thing: Any, folder: Path) -> Any:
    there, back = folder / "there.pickle", folder / "back.pickle"
    there.write_bytes(pickle.dumps(thing))
    subprocess.run([sys.executable, "-c", UNPICKLE, str(there), str(back)], check=True, timeout=120)
    return pickle.loads(back.read_bytes())


def own_experiment() -> Experiment:
    own = sensor_of(f"{OWN}:GatedCamera")
    instruments = (Instrument("gated", own, decoder=own.default_decoder), instrument("amcw"))
    return Experiment(str(SCENES / "plane.xml"), instruments=instruments, width=32, height=24, spp=4)


def test_an_experiment_with_a_sensor_from_a_file_goes_through_another_process(tmp_path: Path) -> None:
    experiment = own_experiment()
    found = through_another_process(experiment, tmp_path)
    assert found == experiment
    assert type(found.instruments[0].sensor) is type(experiment.instruments[0].sensor)


def test_a_bare_sensor_from_a_file_goes_through_another_process(tmp_path: Path) -> None:
    sensor = sensor_of(f"{OWN}:GatedCamera")
    assert through_another_process(sensor, tmp_path) == sensor


def test_a_file_that_is_gone_is_named(tmp_path: Path) -> None:
    copy = tmp_path / "mine.py"
    copy.write_text(re.sub(r'(type_name: ClassVar\[str\] = )"', r'\1"other-', OWN.read_text()))
    content = pickle.dumps(sensor_of(f"{copy}:GatedCamera"))
    (tmp_path / "there.pickle").write_bytes(content)
    copy.unlink()
    command = [sys.executable, "-c", UNPICKLE, str(tmp_path / "there.pickle"), str(tmp_path / "back.pickle")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode
    assert f"expected the Python file {copy}, which defines what was pickled; it is not there." in done.stderr


@pytest.mark.parametrize(
    "thing",
    [
        ScanSettings("plane", path=Turntable(views=3)),
        Motion(rig=ConstantTwist(velocity_m_s=(0.1, 0.0, 0.0))),
    ],
    ids=lambda thing: type(thing).__name__,
)
def test_settings_go_through_another_process(thing: Any, tmp_path: Path) -> None:
    assert through_another_process(thing, tmp_path) == thing


def test_results_go_through_another_process(tmp_path: Path) -> None:
    result = load_result(small_result())
    found = through_another_process(result, tmp_path)
    assert found.experiment == result.experiment
    assert found.info == result.info
    for one, two in zip(result.measurements, found.measurements, strict=True):
        assert one.capture.frames.tobytes() == two.capture.frames.tobytes()
        assert one.image.z.tobytes() == two.image.z.tobytes()
        assert one.rows == two.rows
    capture = load_capture(small_result() / "amcw" / "capture")
    assert isinstance(through_another_process(capture, tmp_path).rig, Rig)
