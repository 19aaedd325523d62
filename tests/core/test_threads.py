"""Functions are compiled when they are first called, with those that they call."""

import subprocess
import sys
import threading

import pytest

from halbach_fe.core.threads import Compiled, compiled, in_threads, share_out


@compiled
def factorial(n):
    return 1 if n < 2 else n * factorial(n - 1)


@compiled
def binomial(n, k):
    return factorial(n) // (factorial(k) * factorial(n - k))


def test_a_function_may_call_others_and_itself():
    assert isinstance(binomial, Compiled)
    assert binomial(6, 2) == 15
    assert binomial.machine_code.signatures  # numba has compiled it
    assert not isinstance(factorial, Compiled)  # in its place is now what numba made of it


def test_numba_is_imported_with_the_first_call():
    """To import it takes a second, which a command that computes no field can do without."""
    code = ("import sys, numpy as np; from halbach_fe.solver.moments import kernels; "
            "before = 'numba' in sys.modules; kernels.apart(np.ones(3), np.zeros(3)); "
            "sys.exit([before, 'numba' in sys.modules] != [False, True])")
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("threads", [1, 2])
def test_one_thread_is_that_of_the_caller(monkeypatch, threads):
    """With two, the control, all of the work is done by others."""
    monkeypatch.setenv("NUMBA_NUM_THREADS", str(threads))
    shares, seen = share_out(100), []
    in_threads(lambda first, last: seen.append((first, last, threading.get_ident())), shares)
    assert sorted(part[:2] for part in seen) == shares
    assert {who == threading.get_ident() for *_, who in seen} == {threads == 1}
