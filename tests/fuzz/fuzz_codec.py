"""Fuzz the laws of ``laws.py``, guided by coverage. `make fuzz` runs this script.

    python tests/fuzz/fuzz_codec.py [--minutes 10] [--law NAME …] [--corpus FOLDER]

It needs atheris, which has wheels for Linux only. `make fuzz` installs it into its own folder. An
input that breaks a law is printed as a line for ``inputs.txt``. The tests repeat those inputs.
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
"""Length of the longest input, bytes."""

HANG = 60
"""Time for one input that counts as a hang, s of the wall clock. A busy machine needs a margin."""

SEEDS = 40
"""Number of random inputs per law in the initial corpus."""

SHARES = {
    "codec": 1,
    "servo_parser": 10,
    "host_parser": 10,
    "fast_parser": 5,
    "driver": 5,
    "servos": 2,
    "arm": 1,
}
"""Relative frequency of each law. One input of an arm takes as long as 100 of a parser."""


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--law", nargs="+", choices=list(laws.LAWS), default=list(laws.LAWS))
    parser.add_argument("--corpus", type=Path, default=Path("build/fuzz"))
    options = parser.parse_args()
    names = [name for name in options.law for _ in range(SHARES[name])]
    # The drivers log every servo that stops responding.
    logging.disable(logging.CRITICAL)
    began = time.monotonic()

    def check_input(data: bytes) -> None:
        """Check the law that the first byte selects with the other bytes."""
        if not data:
            return
        name = names[data[0] % len(names)]
        try:
            laws.LAWS[name](data[1:])
        except BaseException:
            sys.stderr.write(f"\n{name} {data[1:].hex()}\n")
            raise

    # With other laws the first byte would select another law, so each selection has its corpus.
    corpus = options.corpus / "-".join(options.law)
    seed_corpus(corpus, names)
    arguments = [
        f"-max_total_time={round(60 * options.minutes)}",
        f"-max_len={LONGEST}",
        f"-timeout={HANG}",
        "-len_control=0",
        "-print_final_stats=1",
        "-rss_limit_mb=4096",
        f"-artifact_prefix={corpus.parent}/",
        str(corpus),
    ]
    atheris.Setup([sys.argv[0], *arguments], check_input)
    print(f"laws: {', '.join(options.law)}; set up in {time.monotonic() - began:.1f} s", flush=True)
    atheris.Fuzz()


def seed_corpus(folder: Path, names: list[str]) -> None:
    """Write the inputs of earlier failures and random inputs as files.

    Args:
        folder: Folder of the corpus.
        names: Name of the law for each value of the first byte.
    """
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
