"""Webhooks after the Standard Webhooks specification: who may be called, how calls are signed, when they are repeated.

guard      which addresses a webhook may reach, and the one it is sent to
signing    the signature, as receivers verify it
schedule   when a failed delivery is tried again
sending    one attempt: a signed POST with limits on everything the receiver controls
deliverer  the thread that makes the deliveries the catalog lists
"""

from l3ps_platform.webhooks.deliverer import Deliverer
from l3ps_platform.webhooks.guard import Guard
from l3ps_platform.webhooks.signing import new_secret

__all__ = ["Deliverer", "Guard", "new_secret"]
