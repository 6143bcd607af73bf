extends Reference
# The costly features of a table as rays of a physics space: only those that were asked for are cast.
# This file knows nothing about servers or sockets.
#
# A feature named `ray_l075_d08_r010` looks 75 degrees to the left (r: right), 8 down (u: up), 10 m far. Its numbers are
# the distance in metres and then the class that was hit, one-hot. A miss reads its range and the first class.

const Errors = preload("errors.gd")
const FeatureTable = preload("feature_table.gd")

var classes := []  # names; but for the first, which is a miss, a collider is of the class whose name is one of its groups
var other := 1  # the class of a collider that is in none of these groups
var collision_mask := 0x7FFFFFFF
var with_areas := true  # areas are hit too: lava and water that nobody stands on
var _reach := []  # Vector3 of each costly feature: from the eye to the end of its ray, -z is ahead
var _range_m := []
var _one_hot := []  # PoolRealArray of each class


# Take the costly features of a table. A failure names one that is no such ray: cast it yourself.
func setup(table: FeatureTable, class_names: Array) -> Dictionary:
	classes = class_names
	_reach = []
	_range_m = []
	_one_hot = []
	for kind in range(classes.size()):
		var row := []
		for other_kind in range(classes.size()):
			row.append(float(kind == other_kind))
		_one_hot.append(PoolRealArray(row))
	for feature in table.costly:
		var parts: PoolStringArray = feature["name"].split("_")
		if parts.size() != 4 or parts[0] != "ray" or feature["size"] != 1 + classes.size():
			return _no_ray(feature)
		var left = _number(parts[1], "l", "r")
		var down = _number(parts[2], "d", "u")
		var range_m = _number(parts[3], "r", "r")
		if left == null or down == null or range_m == null or range_m <= 0 or range_m > feature["high"]:
			return _no_ray(feature)
		left = deg2rad(left)
		down = deg2rad(down)
		_range_m.append(range_m)
		_reach.append(range_m * Vector3(-cos(down) * sin(left), -sin(down), -cos(down) * cos(left)))
	return {"ok": true}


# The numbers of these features, in this order, for a character whose eye is at `eye` and which looks along its -z.
# `exclude` has its own body. Inside _physics_process only: there the space may be asked.
func cast(space: PhysicsDirectSpaceState, eye: Transform, asked: PoolIntArray, exclude: Array) -> PoolRealArray:
	var values := PoolRealArray()
	for feature in asked:
		var to: Vector3 = eye.xform(_reach[feature])
		var hit := space.intersect_ray(eye.origin, to, exclude, collision_mask, true, with_areas)
		var kind := 0
		if hit.empty():
			values.append(_range_m[feature])
		else:
			values.append(min(eye.origin.distance_to(hit["position"]), _range_m[feature]))
			kind = _class_of(hit["collider"])
		values.append_array(_one_hot[kind])
	return values


# The number after a letter: that of `plus`, or the negative of that of `minus`. Null where it is neither.
static func _number(part: String, plus: String, minus: String):
	var digits := part.substr(1)
	if digits.length() > 3 or not digits.is_valid_integer() or not part[0] in [plus, minus]:
		return null
	return float(digits) if part[0] == plus else -float(digits)


func _no_ray(feature: Dictionary) -> Dictionary:
	return Errors.failure("BAD_SHAPE", "%s is no ray with %d classes" % [feature["name"], classes.size()])


func _class_of(collider: Object) -> int:
	if collider is Node:
		for i in range(1, classes.size()):
			if collider.is_in_group(classes[i]):
				return i
	return other
