"""Tables and curves as in the paper, generated from result files: ``plab report``.

:mod:`plab.report.collect` selects the runs, :mod:`plab.report.statistics` averages and compares them,
:mod:`plab.report.tables` and :mod:`plab.report.figures` present them. The paper's own numbers are in
``paper/``.
"""
