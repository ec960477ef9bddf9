"""One word, one meaning: names that were given up do not come back."""

import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

# What stands in their place today.  Words that are plain English as well (ease, room, bend) cannot be here.
FORMER = {
    "answer_times": "round-trip estimator",
    "arm_zeros": "kinematic calibration",
    "Blindfold": "WithoutTruth",
    "CameraPlace": "CameraExtrinsics",
    "grain": "sensor noise",
    "heed": "joint_weights",
    "honours": "capabilities",
    "keep_apart": "noinline",
    "Lookout": "MarkerFinder",
    "made_up": "synthetic, generated",
    "mischief": "fault",
    "mistrust": "extra_damping",
    "Mixture": "Unobservable",
    "on_demand": "lazy imports",
    "quiet_port": "SleepingPortHandler",
    "Remedies": "LatencyOptions",
    "shout": "broadcast_ping",
    "Sight": "PlacedObservation",
    "sightings": "observations",
    "situation": "RunState",
    "stage_for": "scene_for",
    "suspicion": "diagnosis",
    "unbend": "undistort",
    "wished": "wanted, target",
}
FOLDERS = ("robot_ik", "hardware", "models", "examples", "docs", "tests")


def texts() -> Iterator[tuple[str, str]]:
    """Code and docs; what things were called once is in CHANGELOG.md and in ``robot_ik.reading.FORMER``."""
    found = [ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
    for folder in FOLDERS:
        found += [f for f in (ROOT / folder).rglob("*") if f.suffix in {".py", ".md", ".toml"}]
    for file in found:
        if file != Path(__file__):
            yield str(file.relative_to(ROOT)), file.read_text(encoding="utf-8")


def test_no_word_of_the_former_glossary_is_left() -> None:
    """As a whole name or as a part of one: ``heed``, ``heed_goals``, ``_HEED``."""
    words = "|".join(FORMER)
    former = re.compile(rf"(?<![A-Za-z])(?:{words})(?![A-Za-z])")
    constants = re.compile(rf"(?<![A-Za-z])_?(?:{words.upper()})(?![A-Za-z])")
    found = [
        f"{file}:{number}: {line.strip()}"
        for file, text in texts()
        for number, line in enumerate(text.splitlines(), 1)
        if former.search(line) or constants.search(line)
    ]
    assert found == []
