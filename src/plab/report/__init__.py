"""Tables and curves of the paper, from result files alone: ``plab report``.

:mod:`plab.report.collect` finds the runs that count, :mod:`plab.report.statistics` averages and compares
them, :mod:`plab.report.tables` and :mod:`plab.report.curves` present them. The paper's own numbers are in
``paper/``.
"""
