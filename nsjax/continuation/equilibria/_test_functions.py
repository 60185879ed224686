"""Test functions: what vanishes at the special points along a branch of equilibria, by numbers."""

# Test functions, before those of the guards. A curve leaves its interval at LOW and HIGH, and passes the parameter's
# value at the start at MARK; FOLD is the parameter's part of the tangent, BRANCH the determinant of the equations
# bordered by the tangent, PAIR a product of all sums of two eigenvalues.
LOW, HIGH, MARK, FOLD, BRANCH, PAIR, GUARDS = range(7)
PASSED = (FOLD, PAIR, MARK)  # where the branch goes on as it is
