"""Broken rasterizers, one line each, built from bugs that really happened; every one is killed by a named law."""

from pop_ref.conformance.mutants.baselines import BASELINES
from pop_ref.conformance.mutants.black_box import BLACK_BOXES as SINGLE
from pop_ref.conformance.mutants.black_box import BlackBox
from pop_ref.conformance.mutants.blind import BLIND, BLIND_BOXES, BLIND_PROGRAM
from pop_ref.conformance.mutants.blind_fourth import BLIND_FOURTH, BLIND_FOURTH_PROGRAM
from pop_ref.conformance.mutants.blind_fourth_boxes import BLIND_FOURTH_BOXES
from pop_ref.conformance.mutants.blind_second import BLIND_SECOND, BLIND_SECOND_PROGRAM
from pop_ref.conformance.mutants.blind_second_boxes import BLIND_SECOND_BOXES
from pop_ref.conformance.mutants.blind_third import BLIND_THIRD, BLIND_THIRD_PROGRAM
from pop_ref.conformance.mutants.blind_third_boxes import BLIND_THIRD_BOXES
from pop_ref.conformance.mutants.blind_third_more import (
    BLIND_THIRD_MORE,
    BLIND_THIRD_MORE_BOXES,
    BLIND_THIRD_MORE_PROGRAM,
)
from pop_ref.conformance.mutants.collected import COLLECTED
from pop_ref.conformance.mutants.combined import COMBINED
from pop_ref.conformance.mutants.copies import Mutant, living
from pop_ref.conformance.mutants.geometry import GEOMETRY
from pop_ref.conformance.mutants.methods import METHOD_MUTANTS
from pop_ref.conformance.mutants.pixels import PIXELS
from pop_ref.conformance.mutants.program import PROGRAM as LINES
from pop_ref.conformance.mutants.seams import SEAMS
from pop_ref.conformance.mutants.strangers import STRANGERS, STRANGERS_BOXES
from pop_ref.conformance.mutants.trainers import TRAINERS, TRAINERS_BOXES
from pop_ref.conformance.mutants.training import TRAINING
from pop_ref.conformance.mutants.unseen import UNSEEN
from pop_ref.conformance.mutants.unseen_boxes import UNSEEN_BOXES
from pop_ref.conformance.mutants.whole_steps import WHOLE_STEPS, WHOLE_STEPS_PROGRAM

# of the oracle, and of the program that trains
_BLIND = (*BLIND, *BLIND_SECOND, *BLIND_THIRD, *BLIND_THIRD_MORE, *BLIND_FOURTH)
MUTANTS = (*GEOMETRY, *PIXELS, *TRAINING, *BASELINES, *METHOD_MUTANTS, *_BLIND, *WHOLE_STEPS)
_BLIND_PROGRAM = (
    *(*BLIND_PROGRAM, *BLIND_SECOND_PROGRAM, *BLIND_THIRD_PROGRAM, *BLIND_THIRD_MORE_PROGRAM),
    *BLIND_FOURTH_PROGRAM,
)
PROGRAM = (*LINES, *TRAINERS, *COLLECTED, *STRANGERS, *UNSEEN, *_BLIND_PROGRAM, *WHOLE_STEPS_PROGRAM)
# behind gsplat's signature: one argument broken, several together; autograd, memory, size
BLACK_BOXES = (
    *(*SINGLE, *COMBINED, *SEAMS, *TRAINERS_BOXES, *STRANGERS_BOXES, *UNSEEN_BOXES),
    *(*BLIND_BOXES, *BLIND_SECOND_BOXES, *BLIND_THIRD_BOXES, *BLIND_THIRD_MORE_BOXES, *BLIND_FOURTH_BOXES),
)

# they are counted apart: what the kit has to see from outside says nothing of what stages show
FAMILIES = {"stages of the oracle": MUTANTS, "the program that trains": PROGRAM, "whole rasterizers": BLACK_BOXES}

__all__ = ["BLACK_BOXES", "FAMILIES", "MUTANTS", "PROGRAM", "BlackBox", "Mutant", "living"]
