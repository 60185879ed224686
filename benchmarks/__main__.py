"""The figures of benchmarks/README.md in one run, one script after the other.

python benchmarks            what is compared with other codes, and how cost grows: some 20 minutes
python benchmarks --all      also what accuracy costs, by method: as long again
"""

import argparse
import pathlib
import subprocess
import sys
import time


HERE = pathlib.Path(__file__).parent
RUNS = (
    ("sweep.py", "--out", "sweep.json"),
    ("stops.py", "--rounds", "5", "--out", "stops.json"),
    ("friction.py", "--out", "friction.json"),
    ("cost.py", "--out", "cost.json"),
    ("first_answer.py", "--out", "first_answer.json"),
    ("growth.py", "--repeats", "3", "--out", "growth"),
    ("orbits.py", "--out", "orbits.json"),
    ("branches.py", "--repeats", "3", "--out", "branches.json"),
    ("work_precision.py", "--out", "work_precision"),
)

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--all", action="store_true", help="also what accuracy costs, by method")
for script, *options in RUNS if parser.parse_args().all else RUNS[:-1]:
    print(f"\n## {script}\n", flush=True)
    start = time.perf_counter()
    subprocess.run([sys.executable, script, *options], cwd=HERE, check=True)
    print(f"\n{time.perf_counter() - start:.0f} s", flush=True)
