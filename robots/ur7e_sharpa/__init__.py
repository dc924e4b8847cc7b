"""UR7e arm with the Sharpa Wave right hand."""
