# SPDX-License-Identifier: MIT
"""``python -m dpmaster``: the command line."""

import sys

from dpmaster.cli import main

if __name__ == "__main__":
    sys.exit(main())
