from pathlib import Path
def write_report(study, out, figures):
    return []
