# SPDX-License-Identifier: MIT
"""For all tests: Ctrl-C works, however they were started.

A shell script starts what it puts behind `&` with SIGINT ignored, and a program inherits that. The tests that send SIGINT,
to themselves or to the programs they start, would wait for ever.
"""

import signal

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
