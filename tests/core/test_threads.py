"""Functions are compiled when they are first called, with those that they call."""

import subprocess
import sys

from halbach_fe.core.threads import Compiled, compiled


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
