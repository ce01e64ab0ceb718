"""Broken rasterizers, one line each, built from bugs that really happened; every one is killed by a named law."""

from pop_ref.conformance.mutants.black_box import BlackBox
from pop_ref.conformance.mutants.boxes_arguments import ARGUMENTS
from pop_ref.conformance.mutants.boxes_calls import CALLS
from pop_ref.conformance.mutants.boxes_pairs import PAIRS
from pop_ref.conformance.mutants.boxes_tensors import TENSORS
from pop_ref.conformance.mutants.boxes_views import VIEWS
from pop_ref.conformance.mutants.copies import Mutant, living
from pop_ref.conformance.mutants.oracle_drawing import DRAWING
from pop_ref.conformance.mutants.oracle_training import TRAINING
from pop_ref.conformance.mutants.program import PROGRAM
from pop_ref.conformance.mutants.rounds import ROUNDS

# of the oracle; those of the program that trains are PROGRAM
MUTANTS = (*DRAWING, *TRAINING)
# behind gsplat's signature: one argument broken, several together; single views; autograd, memory, size; other calls
BLACK_BOXES = (*ARGUMENTS, *PAIRS, *VIEWS, *TENSORS, *CALLS)

# they are counted apart: what the kit has to see from outside says nothing of what stages show
FAMILIES = {"stages of the oracle": MUTANTS, "the program that trains": PROGRAM, "whole rasterizers": BLACK_BOXES}

__all__ = ["BLACK_BOXES", "FAMILIES", "MUTANTS", "PROGRAM", "ROUNDS", "BlackBox", "Mutant", "living"]
