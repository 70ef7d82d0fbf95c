"""One-line mutants of the numeric code, and whether a test goes red for each: ``python
-m benchmarks.mutation``.

rules: which expressions may change, and into what. graph: which test files reach a
module. runner: per mutant, one
process forked from one that has the libraries loaded. (mutmut and cosmic-ray know
operators and numbers, but no axis,
no dropped term and no unit; the one skips what a decorator compiles and wants a whole
run's coverage first, the other
starts an interpreter each time.)
"""
