extends Spatial
# A floor with a lake of lava and a wall, each in the group that names its class. Nobody learned to play here: it is
# somewhere to cast rays.


func _init() -> void:
	_add(StaticBody.new(), "ground", Vector3(0, -0.5, 0), Vector3(30, 0.5, 30))
	_add(StaticBody.new(), "wall", Vector3(0, 1.5, -14), Vector3(10, 1.5, 0.5))
	_add(Area.new(), "lava", Vector3(6, 0, 0), Vector3(3, 0.05, 6))


func _add(body: CollisionObject, group: String, middle: Vector3, half: Vector3) -> void:
	var shape := BoxShape.new()
	shape.extents = half
	var collision := CollisionShape.new()
	collision.shape = shape
	body.add_child(collision)
	body.translation = middle
	body.add_to_group(group)
	add_child(body)
