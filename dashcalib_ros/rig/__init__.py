# SPDX-License-Identifier: Apache-2.0
"""Several cameras of one car: where each sits against the first, and how late its clock is."""
