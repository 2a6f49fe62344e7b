"""The bench that drives itself: positioners, the loop that moves them, and what keeps them from harm."""
