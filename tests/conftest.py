# SPDX-License-Identifier: MIT
"""For all tests: Ctrl-C works, however they were started; and the fixtures that several files share.

A shell script starts what it puts behind `&` with SIGINT ignored, and a program inherits that. The tests that send SIGINT,
to themselves or to the programs they start, would wait for ever.
"""

import signal

from slave_rig import master, rig  # noqa: F401

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
