"""KUKA LBR iiwa 14 arm with the Sharpa Wave right hand."""
