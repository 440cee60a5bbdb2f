"""What finished runs say: the table at the end of a run, and the report over one or several of them."""

from vap_core.report.benchmarks import suites_table as suites_table
from vap_core.report.conclude import conclude as conclude
from vap_core.report.conclude import ordered as ordered
from vap_core.report.conclude import results_table as results_table
from vap_core.report.document import report as report
from vap_core.report.text import align as align
