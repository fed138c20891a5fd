"""Write every page and figure: of a run, a close-loop, a comparison, a radio map, coverage."""

from radiotwin.report.closeloop_figures import write_closeloop_figures
from radiotwin.report.closeloop_page import write_closeloop_page
from radiotwin.report.closeloop_words import closeloop_summary
from radiotwin.report.comparison import write_comparison_figures
from radiotwin.report.coverage_figures import write_coverage_pictures
from radiotwin.report.folders import (
    Run,
    check_closeloop_folder,
    check_comparison_folder,
    check_map_target,
    export_map,
    read_run,
    write_closeloop_folder,
    write_comparison_folder,
)
from radiotwin.report.map_figures import write_picture
from radiotwin.report.run_page import write_report

__all__ = ["Run", "check_closeloop_folder", "check_comparison_folder", "check_map_target",
           "closeloop_summary", "export_map", "read_run", "write_closeloop_figures",
           "write_closeloop_folder", "write_closeloop_page", "write_comparison_figures",
           "write_comparison_folder", "write_coverage_pictures", "write_picture", "write_report"]
