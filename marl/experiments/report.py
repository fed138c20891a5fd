def write_report(study, out, figures):
    return []
