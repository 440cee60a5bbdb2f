"""Reports: the table at the end of a run, and the report over one or several finished runs."""

from vap_core.base.tables import align as align
from vap_core.evaluation.report.benchmarks import suites_table as suites_table
from vap_core.evaluation.report.conclude import conclude as conclude
from vap_core.evaluation.report.conclude import ordered as ordered
from vap_core.evaluation.report.conclude import results_table as results_table
from vap_core.evaluation.report.document import report as report
