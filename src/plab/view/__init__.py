"""A page that plays a rollout in 3-D: ``python -m plab.view``, and :func:`plab.view.page.page` from Python.

K3D-jupyter, which draws with three.js, is optional: ``pip install 'plab[view]'``. docs/rendering.md has the
details.
"""
