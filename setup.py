# SPDX-License-Identifier: MIT
"""The compiled half of the package; everything else is in pyproject.toml."""

import sysconfig

from setuptools import setup

setup(
    cffi_modules=["dpmaster/_build.py:binding"],
    zip_safe=False,
    # One wheel for every Python from 3.11 on (stable ABI), except for free-threaded builds, which have none yet.
    options={} if sysconfig.get_config_var("Py_GIL_DISABLED") else {"bdist_wheel": {"py_limited_api": "cp311"}},
)
