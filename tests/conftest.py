# SPDX-License-Identifier: MIT
"""For all tests: Ctrl-C works, however they were started; examples have no time limit; the fixtures that several files share.

A shell script starts what it puts behind `&` with SIGINT ignored, and a program inherits that. The tests that send SIGINT,
to themselves or to the programs they start, would wait for ever.
"""

import signal

from hypothesis import HealthCheck, settings
from slave_rig import master, rig  # noqa: F401

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Of its own accord Hypothesis fails an example that once takes 0.2 s: a busy computer's. The seed is printed as a blob.
settings.register_profile("patient", settings.default, deadline=None, print_blob=True,
                          suppress_health_check=[*settings.default.suppress_health_check, HealthCheck.too_slow])
settings.load_profile("patient")
