"""Many branches in one program."""
