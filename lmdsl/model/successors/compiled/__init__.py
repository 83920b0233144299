"""Images of many boxes by compiled loops: enclosed, along their paths too, and located."""
