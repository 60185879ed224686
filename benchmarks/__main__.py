"""Every figure of benchmarks/README.md in one run, one after the other.

python benchmarks
"""

import pathlib
import subprocess
import sys


HERE = pathlib.Path(__file__).parent
RUNS = (
    ("sweep.py", "--out", "sweep.json"),
    ("cost.py", "--out", "cost.json"),
    ("first_answer.py", "--out", "first_answer.json"),
    ("growth.py", "--out", "growth"),
    ("orbits.py", "--out", "orbits.json"),
    ("branches.py", "--out", "branches.json"),
    ("work_precision.py", "--out", "work_precision"),
)

for script, *options in RUNS:
    print(f"\n## {script}\n", flush=True)
    subprocess.run([sys.executable, script, *options], cwd=HERE, check=True)
