"""How long a user waits at first: the README's example, or `rtac demo`, in a new process with nothing compiled, and once more.

    python benchmarks/bench_commands.py example
    python benchmarks/bench_commands.py demo

The whole process counts: its start, all imports, compiling, and for the demonstration the report and its pictures.
"""

import os
import re
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from measuring import Found, hand_back, once, parser

ROOT = Path(__file__).parents[1]


def command(name: str, folder: Path, *, small: bool) -> list[str]:
    """Return what is run, with what it needs in the folder."""
    if name == "demo":
        return [str(Path(sys.executable).with_name("rtac")), "demo", "--out", str(folder / "demo")]
    (example, *_) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    (folder / "example.py").write_text(example.replace("duration=4.0", "duration=1.0") if small else example)
    return [sys.executable, str(folder / "example.py")]


def main() -> None:
    made = parser(__doc__)
    made.add_argument("name", choices=("example", "demo"))
    chosen = made.parse_args()
    found: Found = {"seconds": {}, "rows": []}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cache = os.environ.get("JAX_COMPILATION_CACHE_DIR", str(folder / "cache"))
        work = command(chosen.name, folder, small=chosen.small)
        environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": cache}
        for call in ("cold", "cached"):
            seconds, said = once(
                lambda: subprocess.run(work, env=environment, check=True, capture_output=True, text=True)
            )
            verdict = next((line for line in said.stdout.splitlines() if line.startswith("Missing")), "")[:60]
            memory = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
            print(f"{chosen.name:10s} {call:8s} {seconds:8.1f} s {memory:8.0f} MiB  {verdict}", flush=True)
            found["seconds"][f"{chosen.name}_{call}"] = round(seconds, 2)
            found["rows"].append({"call": call, "seconds": seconds, "megabytes": memory})
        compiled = sum(file.stat().st_size for file in Path(cache).rglob("*") if file.is_file())
        print(f"{'':10s} compiled code on disk: {compiled / 2**20:.0f} MiB")
    hand_back(chosen, found)


if __name__ == "__main__":
    main()
