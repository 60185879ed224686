"""The figures of benchmarks/README.md in one run, one script after the other.

python benchmarks            what is compared with other codes, and how cost grows: some 20 minutes
python benchmarks --all      also what accuracy costs, by method: as long again
"""

import pathlib
import subprocess
import sys
import time


HERE = pathlib.Path(__file__).parent
RUNS = [
    ("sweep.py", "--out", "sweep.json"),
    ("cost.py", "--out", "cost.json"),
    ("first_answer.py", "--out", "first_answer.json"),
    ("growth.py", "--repeats", "3", "--out", "growth"),
    ("orbits.py", "--out", "orbits.json"),
    ("branches.py", "--repeats", "3", "--out", "branches.json"),
]
METHODS = ("work_precision.py", "--out", "work_precision")

for script, *options in [*RUNS, METHODS] if "--all" in sys.argv[1:] else RUNS:
    print(f"\n## {script}\n", flush=True)
    start = time.perf_counter()
    subprocess.run([sys.executable, script, *options], cwd=HERE, check=True)
    print(f"\n{time.perf_counter() - start:.0f} s", flush=True)
