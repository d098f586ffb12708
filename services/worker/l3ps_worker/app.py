from l3ps_platform.queue import make_app
from l3ps_platform.settings import get_settings

app = make_app(get_settings())
