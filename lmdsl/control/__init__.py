"""The feedback law in use: controller, closed loop, whether the attractor cells are kept."""
