"""When and where the board rests, and what the sensors measure then."""
