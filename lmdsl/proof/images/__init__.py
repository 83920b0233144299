"""Images of boxes under the true map: enclosed, along their paths too, and located."""
