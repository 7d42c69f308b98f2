"""Learners that the supervisor is compared with. Each file registers its algorithm or its variant."""
