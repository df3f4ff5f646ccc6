"""What commands share: options and signals, folders of runs, files and their fields, HTML, films, signs of life."""
