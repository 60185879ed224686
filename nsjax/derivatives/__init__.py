"""Derivatives of solutions: saltation and fundamental matrices, Floquet multipliers, sensitivities."""

from ._saltation import saltation_matrices as saltation_matrices, saltation_matrix as saltation_matrix
from ._sensitivity import Sensitivity as Sensitivity, sensitivity as sensitivity
from ._variational import fundamental_matrix as fundamental_matrix
