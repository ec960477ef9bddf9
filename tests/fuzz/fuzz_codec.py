"""Coverage-guided fuzzing of the laws in ``laws.py``; `make fuzz` runs it.

    python tests/fuzz/fuzz_codec.py [--minutes 10] [--law NAME …] [--corpus FOLDER]

Needs atheris, which has wheels for Linux only: `make fuzz` installs it beside the other tools.  Found inputs
are printed as a line for ``inputs.txt``, which the tests repeat.
"""

from __future__ import annotations

import argparse
import logging
import random
import sys
import time
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["robot_ik.hardware", "dynamixel_sdk"]):
    import laws

LONGEST = 512
HANG = 60
"""s of one input that are a hang; of the wall clock, so that a busy machine takes long for little."""

SEEDS = 40
"""Made-up stories for every law to begin with: packets of all kinds between noise."""

SHARES = {
    "codec": 1,
    "servo_parser": 10,
    "host_parser": 10,
    "fast_parser": 5,
    "driver": 5,
    "servos": 2,
    "arm": 1,
}
"""How often the laws are tried: one trial of an arm takes as long as a hundred of a parser."""


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--law", nargs="+", choices=list(laws.LAWS), default=list(laws.LAWS))
    parser.add_argument("--corpus", type=Path, default=Path("build/fuzz"))
    options = parser.parse_args()
    names = [name for name in options.law for _ in range(SHARES[name])]
    logging.disable(logging.CRITICAL)  # servos are given up all the time
    began = time.monotonic()

    def one(data: bytes) -> None:
        """The first byte chooses the law."""
        if not data:
            return
        name = names[data[0] % len(names)]
        try:
            laws.LAWS[name](data[1:])
        except BaseException:
            sys.stderr.write(f"\n{name} {data[1:].hex()}\n")
            raise

    corpus = options.corpus / "-".join(options.law)  # the first byte means another law elsewhere
    seed_corpus(corpus, names)
    arguments = [f"-max_total_time={round(60 * options.minutes)}", f"-max_len={LONGEST}", f"-timeout={HANG}"]
    arguments += [
        "-len_control=0",
        "-print_final_stats=1",
        "-rss_limit_mb=4096",
        f"-artifact_prefix={corpus.parent}/",
        str(corpus),
    ]
    atheris.Setup([sys.argv[0], *arguments], one)
    print(f"laws: {', '.join(options.law)}; set up in {time.monotonic() - began:.1f} s", flush=True)
    atheris.Fuzz()


def seed_corpus(folder: Path, names: list[str]) -> None:
    """What was found before, and random stories, as files."""
    folder.mkdir(parents=True, exist_ok=True)
    for k, (name, data) in enumerate(laws.known_inputs()):
        if name in names:
            folder.joinpath(f"known{k}").write_bytes(bytes([names.index(name)]) + data)
    rng = random.Random(1)
    for name in dict.fromkeys(names):
        for k in range(SEEDS):
            data = bytes([names.index(name)]) + laws.random_input(rng)
            folder.joinpath(f"{name}{k}").write_bytes(data)


if __name__ == "__main__":
    main()
