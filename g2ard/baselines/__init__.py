"""Other people's methods, built from their papers to be measured beside ours."""
