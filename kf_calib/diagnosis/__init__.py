"""Diagnosis of a misfit: tests of candidate effects, their evidence, the verdict, and stepwise selection."""
