"""Pure mathematics of rigid motions and camera rigs: no files, no scenes.

``lie`` works on torch tensors; the rest on numpy float64 or plain numbers. Importing the package loads neither.
"""
