"""Pure mathematics of rigid motions and camera rigs: no files, no scenes.

``lie`` works on torch tensors; everything else on numpy float64. Importing the package loads neither.
"""
