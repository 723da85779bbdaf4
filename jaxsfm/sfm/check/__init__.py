"""Checks of finished models: whether the photos agree with each other where a model joins them."""
