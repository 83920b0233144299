"""Which gamma is feasible, over ranks: refusals with a proof, and who finds gamma_bar."""
