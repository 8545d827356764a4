"""Doubts about a recording: what stands beside a result, and what a model that explains it takes back."""

from estimators.cli.job import Job


def test_what_the_equations_alone_contradict_is_taken_back_and_nothing_else() -> None:
    work = object.__new__(Job)
    work.inconsistencies = ["current and arm_velocity fit when they are swapped."]
    work.doubts = ["free_1: its samples stop.", *work.inconsistencies]
    work.remark = "Held out: run_d.\n" + "\n".join(f"Doubtful: {one}" for one in work.doubts)
    work.withdraw_inconsistencies()
    assert work.remark == "Held out: run_d.\nDoubtful: free_1: its samples stop."
    assert work.doubts == ["free_1: its samples stop."]
    work.withdraw_inconsistencies()
    assert work.doubts == ["free_1: its samples stop."]
