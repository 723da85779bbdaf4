"""From photos to verified pairs, on all devices."""
