"""Three questions that head a report: in time with the speech, like the speaker, new."""
