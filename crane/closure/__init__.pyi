from .closure import Closure as Closure
