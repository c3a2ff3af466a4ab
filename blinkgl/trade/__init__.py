"""What accuracy costs: settings timed and judged against a converged reference (``blinkgl trade``)."""
