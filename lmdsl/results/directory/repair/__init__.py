"""Problems repaired until a proof arrives: pairs are dropped, kept, and checked again."""
