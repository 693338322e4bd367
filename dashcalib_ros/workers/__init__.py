# SPDX-License-Identifier: Apache-2.0
"""Where stages run: child processes, or this one; with equal results."""
