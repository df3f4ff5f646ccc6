"""What an evaluation leaves: pages, pictures, films, recordings for a viewer."""
