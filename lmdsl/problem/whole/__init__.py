"""A problem as a whole: changed copies of it, and what it says in words."""
