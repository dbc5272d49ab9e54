def write_report(output, definitions, rows):
    pass
