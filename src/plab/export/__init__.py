"""Rollouts for ParaView and Blender: ``plab export``, and :mod:`plab.export.writers` from Python.

PyVista is optional: ``pip install 'plab[render]'``. docs/rendering.md has the details.
"""
