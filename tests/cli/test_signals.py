"""Signals that ask a run to end."""

import signal

import pytest

from kf_calib.cli.failures import Interrupter, answered


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGTERM])
def test_only_a_hang_up_is_ignored_after_it_was_answered(number: signal.Signals) -> None:
    """Terminal and shell both send a SIGHUP; the second must not kill what is writing its results."""
    before = signal.getsignal(number)
    seen: list[signal.Signals] = []
    try:
        with answered(seen.append):
            signal.raise_signal(number)
        assert seen == [number]
        assert signal.getsignal(number) is (signal.SIG_IGN if number == signal.SIGHUP else before)
    finally:
        signal.signal(number, before)


def test_an_interrupt_waits_for_what_must_be_whole() -> None:
    interrupt, done = Interrupter(), list[str]()
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), answered(interrupt):
        with interrupt.finished_first():
            signal.raise_signal(signal.SIGTERM)
            done.append("written")
        done.append("never")
    assert done == ["written"] and signal.getsignal(signal.SIGTERM) is before
    with pytest.raises(KeyboardInterrupt), answered(Interrupter()):
        signal.raise_signal(signal.SIGTERM)
        done.append("never")
    assert done == ["written"]
