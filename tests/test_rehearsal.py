"""Compiling ahead: what is rehearsed must be the whole way, and leave nobody behind."""

import multiprocessing

from shapecat.rehearsal import compile_ahead, find_ball, recognize_ball


def test_the_rehearsals_go_all_the_way() -> None:
    """Where nothing is found, most kernels are not called and stay uncompiled."""
    assert find_ball() == 1
    assert recognize_ball() == "ball"


def test_the_other_process_ends_with_the_block() -> None:
    before = set(multiprocessing.active_children())
    with compile_ahead():
        pass
    left = set(multiprocessing.active_children()) - before
    for process in left:
        process.join(timeout=10)
    assert not any(process.is_alive() for process in left)
