"""One word, one meaning: names that were given up do not come back."""

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

# What stands in their place today.  Words that are plain English as well (ease, room, bend) cannot be here.
FORMER = {
    "AnswerTimes": "RoundTripEstimator",
    "answer_times": "round-trip estimator",
    "arm_zeros": "kinematic calibration",
    "Blindfold": "Frame.without_truth",
    "CameraPlace": "CameraExtrinsics",
    "CompiledAhead": "Precompilation",
    "dice": "rng, a random generator",
    "energise": "enable_torque",
    "fit_print": "fit_photometric",
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
    "pose_words": "pose_text",
    "quiet_port": "SleepingPortHandler",
    "QuietPortHandler": "SleepingPortHandler",
    "Remedies": "LatencyOptions",
    "shout": "broadcast_ping",
    "Sight": "observation",
    "sightings": "observations",
    "situation": "RunState",
    "stage_for": "scene_for",
    "suspicion": "diagnosis",
    "turn_quat": "rotate_quat",
    "unbend": "undistort",
    "wish": "mode, target",
    "wished": "wanted, target",
}
LETTER = r"[^\W\d_]"
FOLDERS = ("robot_ik", "hardware", "models", "examples", "docs", "tests")


def texts() -> Iterator[tuple[str, str]]:
    """Code and docs; former names are in CHANGELOG.md."""
    found = [ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
    for folder in FOLDERS:
        found += [f for f in (ROOT / folder).rglob("*") if f.suffix in {".py", ".md", ".toml"}]
    for file in found:
        if file != Path(__file__):
            yield str(file.relative_to(ROOT)), file.read_text(encoding="utf-8")


def test_no_word_of_the_former_glossary_is_left() -> None:
    """As a whole name or as a part of one: ``heed``, ``heed_goals``, ``_HEED``."""
    words = "|".join(FORMER)
    former = re.compile(rf"(?<!{LETTER})(?:{words})(?!{LETTER})")
    constants = re.compile(rf"(?<!{LETTER})_?(?:{words.upper()})(?!{LETTER})")
    found = [
        f"{file}:{number}: {line.strip()}"
        for file, text in texts()
        for number, line in enumerate(text.splitlines(), 1)
        if former.search(line) or constants.search(line)
    ]
    assert found == []


def test_each_class_name_stands_for_one_class() -> None:
    """In the whole package; a leading underscore makes no other name."""
    places = defaultdict(list)
    for folder in ("robot_ik", "hardware"):
        for file in sorted((ROOT / folder).rglob("*.py")):
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ClassDef):
                    places[node.name.lstrip("_")].append(f"{file.relative_to(ROOT)}:{node.lineno}")
    assert len(places) > 500
    assert {name: found for name, found in places.items() if len(found) > 1} == {}
