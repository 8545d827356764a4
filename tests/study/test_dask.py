"""Studies on a local dask cluster of two workers."""

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from deadly_work import Deadly
from small_study import batched, same_bits, small

import estimators as est
from estimators.study import run

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def deaths(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a file for each worker that is to die."""
    return tmp_path_factory.mktemp("deaths")


@pytest.fixture(scope="module")
def executor(deaths: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    distributed = pytest.importorskip("distributed")
    import dask

    with (
        pytest.MonkeyPatch.context() as patch,
        dask.config.set({"distributed.worker.daemon": False}),
    ):
        patch.setenv("RTAC_DEADLY", str(deaths))
        patch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), str(ROOT / "tests"), os.environ.get("PYTHONPATH", "")]))
        with (
            distributed.LocalCluster(
                n_workers=2,
                threads_per_worker=1,
                dashboard_address=None,
                silence_logs="CRITICAL",
                local_directory=str(tmp_path_factory.mktemp("dask")),
            ) as cluster,
            distributed.Client(cluster) as client,
        ):
            yield client.get_executor()


@pytest.mark.slow
def test_the_example_of_the_readme_runs_on_two_workers(
    executor: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    (example,) = (block for block in blocks if "StudySpec.from_toml" in block)
    on_cluster = example.replace('out="weak_form"', 'out="weak_form", executor=executor, chunk=5')
    assert on_cluster != example
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"executor": executor}
    exec(on_cluster.replace("rtac.configure()", ""), names)
    assert "20 of 20 repetitions; none failed" in capsys.readouterr().out
    chunks = sorted(path.name for path in (tmp_path / "weak_form" / "chunks").iterdir())
    assert chunks == [f"{first:08d}.h5" for first in (0, 5, 10, 15)]
    found = names["found"]
    here = est.study(found.spec, progress=False)
    assert same_bits(found, here)
    assert np.all(np.isfinite(found["estimate"].sel(parameter="v/k").values))


@pytest.mark.slow
def test_fits_side_by_side_have_the_bits_that_they_have_here(executor: Any) -> None:
    there = est.study(batched(), executor=executor, chunk=3, progress=False)
    assert set(there["verdict"].values[:, 0]) == {"successful"}
    assert same_bits(there, est.study(batched(), progress=False))


@pytest.mark.slow
def test_the_bits_are_the_same_although_a_worker_is_killed(executor: Any, deaths: Path) -> None:
    (deaths / "1").touch()
    work = Deadly(small())
    index, arrays = run.repeated(work, "", executor=executor, out=None, chunk=3, progress=False)
    assert same_bits(est.StudyResults(small(), index, work.layout, arrays), est.study(small(), progress=False))
    assert not list(deaths.iterdir())
