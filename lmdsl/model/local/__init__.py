"""The local controller: feedback on the attractor cells, and the linearisation it rests on."""
