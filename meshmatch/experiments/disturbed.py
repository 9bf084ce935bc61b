"""A collection of generated bodies whose fitting is killed again and again, beside one that nobody disturbed.

`meshmatch fit` runs in a process of its own, which gets SIGKILL with all its workers every so many seconds and is then
started again, until it comes to its end by itself. The finished fits must be those of the run that nobody disturbed, bit
for bit, and no temporary file may be left.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated

from typer import Option

from meshmatch.collections.stores import LOCK
from meshmatch.errors import OptionError
from meshmatch.experiments import runner
from meshmatch.experiments.groupwise import contents
from meshmatch.experiments.human_bodies import write_bodies

COLUMNS = {"bodies": "bodies:d", "kills": "kills:d", "undisturbed, s": "undisturbed_s:.0f", "killed, s": "killed_s:.0f"}
COLUMNS |= {"same bits": "same", "left over": "left_over:d", "good": "good:d"}


def run_fit(shapes: Path, output: Path, jobs: int) -> subprocess.Popen[bytes]:
    """`meshmatch fit` in a session of its own."""
    words = ["fit", str(shapes), "-o", str(output), "--model", "human", "--jobs", str(jobs), "-q", "--json"]
    return subprocess.Popen([sys.executable, "-m", "meshmatch", *words], start_new_session=True, stdout=subprocess.PIPE)


def killed_until_done(shapes: Path, output: Path, jobs: int, every: float) -> int:
    """How often it was killed before it came to its end."""
    kills = 0
    while True:
        process = run_fit(shapes, output, jobs)
        try:
            process.communicate(timeout=every)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            kills += 1
            runner.tell(f"kill {kills}: {len(list(output.rglob('*.safetensors')))} files")
            continue
        if process.returncode:
            raise OptionError(f"meshmatch fit ended with {process.returncode}")
        return kills


@runner.command
def main(
    bodies: Annotated[int, Option(min=2, help="generated bodies")] = 500,
    every: Annotated[float, Option(min=1.0, help="seconds between two kills")] = 60.0,
    jobs: Annotated[int, Option(min=1, help="processes")] = 2,
    work: Annotated[Path | None, Option(help="folder of all files; by default a temporary one")] = None,
    seed: runner.Seed = 0,
) -> runner.Report:
    """Kill the fitting of a collection again and again."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = work or Path(temporary)
        shapes, whole, killed = folder / "shapes", folder / "undisturbed", folder / "killed"
        write_bodies(shapes, bodies, seed)
        began = time.perf_counter()
        process = run_fit(shapes, whole, jobs)
        verdicts = json.loads(process.communicate()[0])["verdicts"]
        undisturbed = time.perf_counter() - began
        runner.tell(f"undisturbed: {undisturbed:.0f} s")
        began = time.perf_counter()
        kills = killed_until_done(shapes, killed, jobs, every)
        spent = time.perf_counter() - began
        left = [path for path in killed.rglob(".*") if path.name != LOCK]
        row = {"bodies": bodies, "kills": kills, "undisturbed_s": undisturbed, "killed_s": spent}
        row |= {"same": contents(whole) == contents(killed), "left_over": len(left), "good": verdicts["good"]}
    return runner.Report({"rows": [row]}, [runner.table("Killed and gone on", [row], COLUMNS)])


if __name__ == "__main__":
    sys.exit(main())
