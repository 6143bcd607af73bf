extends KinematicBody
# One character of the demo: it walks as its last action says, and knows its free numbers.
# The bundle's axes are x east, y north, z up; Godot's -z is north and its y is up.

const EYE_M := 1.2
const SPEED_MPS := 5.0
const TURN_RAD := PI / 6  # of one decision
const DECISION_S := 0.1
const JUMP_MPS := 4.0
const GRAVITY := Vector3(0, -9.8, 0)

var goal := Vector3.ZERO
var _velocity := Vector3.ZERO
var _forward := 0.0


func _init() -> void:
	var shape := BoxShape.new()
	shape.extents = Vector3(0.3, 0.7, 0.3)
	var collision := CollisionShape.new()
	collision.shape = shape
	collision.translation = Vector3(0, 0.7, 0)
	add_child(collision)
	collision_layer = 2  # rays and walkers look at layer 1, so none of them meets another walker


# `action` is turn, forward, jump: done from now on until the next one.
func decide(action: PoolRealArray) -> void:
	rotate_y(action[0] * TURN_RAD)
	_forward = action[1]
	if action[2] > 0.5 and is_on_floor():
		_velocity.y = JUMP_MPS


func walk(delta: float) -> void:
	var ahead := -transform.basis.z * _forward * SPEED_MPS
	_velocity = move_and_slide(Vector3(ahead.x, _velocity.y, ahead.z) + GRAVITY * delta, Vector3.UP)


func eye() -> Transform:
	return Transform(transform.basis, translation + Vector3(0, EYE_M, 0))


# The 15 free numbers of the bundles easy and hard: position, orientation, velocity, goal, goal_relative, on_ground.
func free_numbers() -> PoolRealArray:
	var to_goal := transform.basis.xform_inv(goal - translation)
	var ahead := -transform.basis.z
	return PoolRealArray([
		translation.x, -translation.z, translation.y,
		ahead.x, -ahead.z,
		_velocity.x, -_velocity.z, _velocity.y,
		goal.x, -goal.z, goal.y,
		-to_goal.z, -to_goal.x, to_goal.y,
		1.0 if is_on_floor() else 0.0,
	])
